"""Self-play against past policies: who plays whom, the pool in files, ratings, a game without a best move."""

import os
import random
import shutil
import time
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import torch
from matrix_game import EQUILIBRIUM
from tensordict import TensorDict
from test_train import assert_same, options, rows, start, wait_for_rows, without_times

from mappo_unity import keys
from mappo_unity.cli import eval_main, train_main
from mappo_unity.config.compose import compose_config
from mappo_unity.config.schema import (
    Backend,
    CollectConfig,
    EnvConfig,
    MatchConfig,
    ModelConfig,
    OpponentDraw,
    PPOConfig,
    Schedule,
    SelfPlayConfig,
    ValueNormKind,
)
from mappo_unity.errors import ConfigError
from mappo_unity.keys import LEARNER
from mappo_unity.learning.networks.distributions import ActionLayout
from mappo_unity.learning.networks.opponents import Opponents
from mappo_unity.policies.league.ratings import expected
from mappo_unity.runs import checkpoint
from mappo_unity.training.self_play.draw import LATEST, draw_teams
from mappo_unity.training.self_play.pool import Record
from mappo_unity.training.trainer import train

GAMES = 8
SIDES = {0: ["A?team=0"], 1: ["A?team=1"]}
HERE = Path(__file__).parent
GAME = [
    "env=custom", "env.name=Rps", "env.factory=matrix_game:make", "env.params.games=8", "model.hidden=[8]",
    "collect.batch_size=64", "self_play.save_steps=64", "self_play.swap_steps=0", "export_onnx=false",
    "log.loggers=[]",
]  # fmt: skip


def matrix_game(iterations, games=GAMES, rounds=4, **changes):
    """Options of a run on the matrix game, with a pool whose every change falls into a few iterations."""
    steps = 2 * games * rounds
    self_play = SelfPlayConfig(save_steps=steps, window=3, swap_steps=0, num_opponents=2)
    params = {"games": games}
    cfg = options(
        1,
        env=EnvConfig(name="Rps", backend=Backend.custom, factory="matrix_game:make", params=params),
        model=ModelConfig(hidden=[8], normalize_obs=False),
        collect=CollectConfig(batch_size=steps),
        matches=MatchConfig(interval=None),
        self_play=self_play,
        max_steps=iterations * steps,
        checkpoint_interval=steps,
        export_onnx=False,
    )
    return replace(cfg, **changes)


def draw(count=4000, learning=None, records=None, **changes):
    cfg = SelfPlayConfig(save_steps=1, **changes)
    records = records or {number: Record(1200.0) for number in range(5)}
    teams = {"A?team=0": count, "A?team=1": count}
    rng = np.random.default_rng(0)
    return draw_teams(rng, cfg, SIDES, teams, dict.fromkeys(teams, records), learning)


# --- who meets whom


def test_one_side_of_a_match_against_a_past_policy_learns_and_both_against_the_newest():
    players = draw(play_against_latest_model_ratio=0.3, num_opponents=3)
    first, second = players["A?team=0"], players["A?team=1"]
    assert not ((first != LEARNER) & (second != LEARNER)).any()
    both = ((first == LEARNER) & (second == LEARNER)).mean()
    assert abs(both - 0.3) < 4 * np.sqrt(0.3 * 0.7 / 4000)
    share = (first != LEARNER).mean()
    assert abs(share - 0.35) < 4 * np.sqrt(0.35 * 0.65 / 4000)
    assert 1 <= len(set(first.tolist() + second.tolist()) - {LEARNER}) <= 3


def test_one_side_learns_where_teams_take_turns():
    players = draw(learning=1, play_against_latest_model_ratio=0.5, team_change=10)
    assert (players["A?team=1"] == LEARNER).all()
    other = players["A?team=0"]
    assert (other != LEARNER).all()
    assert abs((other == LATEST).mean() - 0.5) < 4 * np.sqrt(0.25 / 4000)


def test_the_hardest_opponents_are_drawn_most():
    records = {number: Record(1200.0, lost, 98.0) for number, lost in enumerate((9.0, 49.0, 98.0))}
    drawn = []
    for seed in range(400):
        rng = np.random.default_rng(seed)
        cfg = SelfPlayConfig(opponents=OpponentDraw.hardest, play_against_latest_model_ratio=0)
        teams = {"A?team=0": 1, "A?team=1": 1}
        players = draw_teams(rng, cfg, SIDES, teams, dict.fromkeys(teams, records), learning=0)
        drawn.append(int(players["A?team=1"][0]))
    # (1 - p)^2 with p = (lost + 1) / (played + 2): 0.1, 0.5, 0.99
    weights = np.array([0.9, 0.5, 0.01]) ** 2
    shares = np.bincount(drawn, minlength=3) / len(drawn)
    wanted = weights / weights.sum()
    assert (abs(shares - wanted) < 4 * np.sqrt(wanted * (1 - wanted) / len(drawn)) + 1e-3).all()


# --- who plays a team


class Counting:
    """An actor that always chooses its number, and with a memory says how often it has been asked."""

    in_keys = [keys.FIRST]
    layout = ActionLayout(1, ())

    def __init__(self, number, memory_size=0):
        self.number, self.memory_size, self.calls = number, memory_size, 0
        self.has_memory = memory_size > 0

    def params(self, entries):
        self.calls += 1
        if not self.memory_size:
            return torch.full((*entries.batch_size, 1), float(self.number)), None
        memory = entries.get(keys.MEMORY) + 1
        return memory.clone(), memory

    def distribution(self, params, entries):
        return Mode(params)


class Mode(NamedTuple):
    """A distribution that draws its parameters."""

    params: torch.Tensor

    def sample(self):
        return self.params


def entries(acting, first):
    """Entries of teams of two."""
    flags = {keys.ACTING: acting, keys.FIRST: first}
    out = {key: torch.tensor(value, dtype=torch.bool).unsqueeze(-1) for key, value in flags.items()}
    out[keys.ACTION] = torch.zeros(len(acting), 2, 1)
    return TensorDict(out, [len(acting), 2])


def play(opponents, acting, first):
    step = entries(acting, first)
    opponents.act("A", step, opponents.take_places("A", step))
    return step


def test_who_plays_a_team_changes_where_its_episode_begins():
    opponents = Opponents()
    opponents.actors["A"] = {3: Counting(3), 4: Counting(4)}
    opponents.plan("A", torch.tensor([3, LEARNER, 4]))

    # the second member of the first team begins later: its team is in the middle of an episode
    step = play(opponents, [[1, 1], [1, 1], [1, 1]], [[1, 1], [1, 1], [0, 0]])
    assert step[keys.ACTION].squeeze(-1).tolist() == [[3, 3], [0, 0], [0, 0]]
    assert step[keys.PLAYER].squeeze(-1).tolist() == [[3, 3], [LEARNER] * 2, [LEARNER] * 2]
    assert step[keys.ACTING].squeeze(-1).tolist() == [[False] * 2, [True] * 2, [True] * 2]

    opponents.plan("A", torch.tensor([4, 3, 4]))
    assert opponents.used("A") == {3, 4}
    step = play(opponents, [[1, 1], [1, 1], [1, 0]], [[1, 0], [0, 0], [1, 0]])
    assert step[keys.ACTION].squeeze(-1).tolist() == [[3, 3], [0, 0], [4, 4]]
    step = play(opponents, [[1, 1], [1, 1], [1, 1]], [[1, 1], [1, 1], [0, 0]])
    assert step[keys.ACTION].squeeze(-1).tolist() == [[4, 4], [3, 3], [4, 4]]
    assert opponents.actors["A"][4].calls == 2  # two teams, one forward pass


def test_opponents_keep_memories_of_their_own():
    opponents = Opponents()
    opponents.actors["A"] = {3: Counting(3, memory_size=1)}
    opponents.plan("A", torch.tensor([3, LEARNER]))
    play(opponents, [[1, 1], [1, 1]], [[1, 1], [1, 1]])
    step = play(opponents, [[1, 0], [1, 1]], [[0, 0], [0, 0]])
    assert step[keys.ACTION].squeeze(-1).tolist() == [[2, 2], [0, 0]]

    state = opponents.state_dict()
    again = Opponents()
    again.actors = opponents.actors
    again.load_state_dict(state, "cpu")
    # who was not asked keeps its memory; an episode begins with none
    for which in (opponents, again):
        step = play(which, [[1, 1], [1, 1]], [[0, 0], [1, 1]])
        assert step[keys.ACTION].squeeze(-1).tolist() == [[3, 2], [0, 0]]
    step = play(again, [[1, 1], [1, 1]], [[1, 1], [0, 0]])
    assert step[keys.ACTION].squeeze(-1).tolist() == [[1, 1], [0, 0]]


# --- runs


def test_what_opponents_do_neither_counts_nor_is_learnt_nor_moves_a_normaliser(tmp_path):
    seen = []

    def look(state):
        learner = state.setup.learners["Rps"]
        players = state.setup.opponents.playing["Rps"]
        count = float(learner.actor[0].module.encoder.norm.count)
        seen.append((state.agent_steps, count, float((players != LEARNER).sum())))

    cfg = matrix_game(3, model=ModelConfig(hidden=[8], normalize_obs=True))
    fully = replace(cfg.self_play, play_against_latest_model_ratio=0.0)
    train(replace(cfg, self_play=fully), tmp_path / "run", after_iteration=look)

    for steps, count, frozen in seen:
        assert count == pytest.approx(steps, abs=1)  # the statistics have seen what counts, and no more
        assert frozen == GAMES  # of two sides one
    # the episodes of those who learn alone: a batch holds as many decisions, one an episode
    first = rows(tmp_path / "run")[0]
    assert int(first["episodes_new"]) == int(first["agent_steps"]) == 2 * GAMES * 4


def test_a_side_that_does_not_learn_takes_no_turns(tmp_path):
    lines = ["env=StrikersVsGoalie", "env.num_areas=4", "max_steps=360", "collect.batch_size=120"]
    lines += ["behaviors.Goalie.train=false", "self_play.save_steps=120", "self_play.team_change=120"]
    lines += ["self_play.play_against_latest_model_ratio=0", "model.hidden=[8]", "matches.interval=null"]
    seen = []

    def note(state):
        players = state.setup.opponents.following
        seen.append({name: own.unique().tolist() for name, own in players.items()})

    train(compose_config(lines).config, tmp_path / "run", after_iteration=note)
    # the strikers learn in every match, against the one goalie there is
    assert seen == [{"Goalie": [LEARNER], "Striker": [LEARNER]}] * len(seen) and len(seen) >= 3


def test_opening_rivals_draws_no_number_of_training(tmp_path):
    cfg = matrix_game(1)
    other = train(cfg, tmp_path / "other").last_checkpoint
    cfg.self_play.fixed = [str(other)]

    def look(state):
        before = torch.get_rng_state()
        assert str(other) in state._rivals()
        assert torch.equal(torch.get_rng_state(), before)

    train(cfg, tmp_path / "run", after_iteration=look)


def test_a_run_may_begin_with_a_past_policy_of_another(tmp_path, capsys):
    train(matrix_game(2), tmp_path / "other")
    past = sorted((tmp_path / "other" / "pool").glob("step_*.pt"))[-1]
    assert train_main([*GAME, f"init_from={past}", "max_steps=64", f"hydra.run.dir={tmp_path / 'run'}"]) == 0
    out = capsys.readouterr().out
    assert "copied   actor.net.0.weight" in out
    assert "skipped  critic " in out and "the file holds none: a new one learns" in out


def test_elo_moves_as_in_ml_agents(tmp_path):
    state_of = []
    cfg = matrix_game(1)
    train(cfg, tmp_path / "run", after_iteration=lambda state: state_of.append(state))
    self_play = state_of[0].self_play
    record = self_play._records["Rps"][0]
    self_play.elo["Rps"], record.elo = 1300.0, 1200.0

    class Batch:
        results = [
            type("R", (), {"behavior": "Rps?team=1", "opponent": 0, "score": 1.0})(),
            type("R", (), {"behavior": "Rps?team=0", "opponent": LATEST, "score": 0.0})(),
            type("R", (), {"behavior": "Rps?team=0", "opponent": 99, "score": 0.0})(),
        ]

    metrics = self_play._count(Batch())
    # E = 1 / (1 + 10^(-100/400)) = 0.640065; the opponent won
    assert self_play.elo["Rps"] == pytest.approx(1300 - 0.640065, abs=1e-6)
    assert record.elo == pytest.approx(1200 + 0.640065, abs=1e-6)
    assert expected(1300, 1200) == pytest.approx(0.640065, abs=1e-6)
    assert metrics["Self-play/ELO"] == self_play.elo["Rps"] and metrics["points_vs_pool"] == 0.0


def check_resume(cfg, folder):
    """Compare a run with one in two parts, to the bit; return its last checkpoint."""
    whole = train(cfg, folder / "whole")
    train(cfg, folder / "parts", after_iteration=lambda s: "interrupted" if s.iteration == 4 else None)
    path, _ = checkpoint.newest_good(folder / "parts")
    resumed = train(cfg, folder / "parts", path)

    assert rows(folder / "whole") == rows(folder / "parts")
    first, second = (checkpoint.load(o.last_checkpoint) for o in (whole, resumed))
    assert_same(without_times(first), without_times(second))
    return first


@pytest.mark.parametrize("changes", [{}, {"team_change": 200, "opponents": OpponentDraw.hardest}])
def test_a_run_with_a_pool_resumes_to_the_bit(tmp_path, changes):
    cfg = matrix_game(8, matches=MatchConfig(interval=128, count=4))
    cfg = replace(cfg, self_play=replace(cfg.self_play, fixed=["random"], **changes))
    check_resume(cfg, tmp_path)
    files = [sorted(p.name for p in (tmp_path / run / "pool").iterdir()) for run in ("whole", "parts")]
    assert files[0] == files[1] and len(files[0]) <= 3 + 5 + 1  # the window, and what kept checkpoints name


def test_a_run_that_dies_at_any_iteration_has_the_files_that_its_last_checkpoint_refers_to(tmp_path):
    cfg = matrix_game(4, keep_checkpoints=1, checkpoint_interval=3 * 64)
    cfg = replace(cfg, self_play=replace(cfg.self_play, window=1, play_against_latest_model_ratio=0.0))
    run = tmp_path / "run"
    train(cfg, run, after_iteration=lambda s: shutil.copytree(run, tmp_path / str(s.iteration)) and None)

    for iteration in (2, 4):
        died = tmp_path / str(iteration)
        path, _ = checkpoint.newest_good(died)
        train(cfg, died, path, after_iteration=lambda s: "interrupted")
        assert int(rows(died)[-1]["agent_steps"]) > 0
    assert len(list((run / "pool").iterdir())) <= 1 + 3 + 1  # the window, and what came since a checkpoint


def test_two_scenes_with_two_sides_learn_with_a_pool(tmp_path):
    for name in ("SoccerTwos", "StrikersVsGoalie"):
        self_play = SelfPlayConfig(save_steps=60, swap_steps=0, play_against_latest_model_ratio=0.25)
        cfg = options(
            3,
            env=EnvConfig(name=name, num_areas=4),
            collect=CollectConfig(batch_size=120),
            self_play=self_play,
            matches=MatchConfig(interval=None),
            max_steps=360,
        )
        train(cfg, tmp_path / name)
        last = rows(tmp_path / name)[-1]
        assert float(last["pool_size"]) == 3 and float(last["agent_steps"]) >= 360
        names = ["Striker", "Goalie"] if name == "StrikersVsGoalie" else []
        assert all(f"{policy}/Self-play/ELO" in last for policy in names) and "Self-play/ELO" in last


def test_files_that_are_missing_or_damaged_are_told_and_left_out_only_if_asked(tmp_path, capsys):
    run = tmp_path / "run"
    assert (
        train_main(
            [*GAME, "self_play.play_against_latest_model_ratio=0", "max_steps=256", f"hydra.run.dir={run}"]
        )
        == 0
    )
    files = sorted((run / "pool").iterdir())
    assert eval_main([f"run={files[-1]}", "opponent=random", "episodes=10"]) == 0
    capsys.readouterr()

    assert train_main([f"resume={files[-1]}", "max_steps=320"]) == 2
    assert "holds a policy, but not what resuming needs" in capsys.readouterr().err

    files[1].write_bytes(files[1].read_bytes()[:100])
    assert train_main([f"resume={run}", "max_steps=320"]) == 2
    said = capsys.readouterr().err
    assert "an opponent of the pool cannot be loaded: checkpoint" in said and files[1].name in said
    assert "self_play.skip_missing=true resumes without it" in said and said.count("\n") == 1

    files[2].unlink()
    assert train_main([f"resume={run}", "max_steps=320", "self_play.skip_missing=true"]) == 0
    said = capsys.readouterr().out
    assert said.count("an opponent of the pool is left out") == 2
    assert int(rows(run)[-1]["agent_steps"]) >= 320


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        (["env=3DBall", "self_play.save_steps=1000"], "self-play needs an environment with two sides"),
        (
            ["self_play.save_steps=0"],
            "self_play.save_steps=0 is out of range: self_play.save_steps must be >= 1",
        ),
        (["self_play.play_against_latest_model_ratio=1.5"], "must be from 0 to 1"),
        (["self_play.opponents=best"], "uniform, hardest"),
        (["self_play.fixed=[nowhere.onnx]"], "self_play.fixed=nowhere.onnx does not exist"),
        (["self_play.fixed=['']"], "self_play.fixed has an empty entry"),
        (["self_play.window=0"], "self_play.window must be >= 1"),
    ],
)
def test_mistakes_are_told_in_a_line(lines, words, tmp_path, capsys):
    given = ["env=SoccerTwos", "env.num_areas=1", "max_steps=10", *lines, f"hydra.run.dir={tmp_path / 'run'}"]
    if "env=3DBall" in lines:
        given.remove("env=SoccerTwos")
    assert train_main(given) == 2
    said = capsys.readouterr().err
    assert words in said and said.count("\n") == 1


def test_a_checkpoint_of_another_environment_is_no_fixed_opponent(tmp_path):
    outcome = train(options(1), tmp_path / "ball")
    cfg = matrix_game(1, self_play=SelfPlayConfig(fixed=[str(outcome.last_checkpoint)]))
    with pytest.raises(ConfigError, match=r"self_play.fixed: checkpoint .* cannot play 'Rps\?team="):
        train(cfg, tmp_path / "run")


def finish(process):
    _, errors = process.communicate(timeout=300)
    assert process.returncode == 0, errors


@pytest.mark.slow
def test_killed_at_any_moment_a_run_has_the_same_pool_and_ratings(tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(HERE), os.environ.get("PYTHONPATH", "")]))
    lines = [
        *GAME, "max_steps=9600", "checkpoint_interval=320", "matches.interval=960", "matches.count=4",
        "self_play.window=5", "log.progress=false", "hydra.run.dir=run",
    ]  # fmt: skip
    for name in ("whole", "cut"):
        (tmp_path / name).mkdir()
    finish(start(tmp_path / "whole", *lines))

    generator, arguments, reached = random.Random(0), lines, 5
    for _ in range(6):
        process = start(tmp_path / "cut", *arguments)
        wait_for_rows(tmp_path / "cut", reached + generator.randint(1, 10), process)
        time.sleep(generator.uniform(0.0, 0.1))
        process.kill()
        process.communicate()
        reached = len((tmp_path / "cut" / "run" / "metrics.csv").read_text().splitlines())
        arguments = ["resume=run"]
    finish(start(tmp_path / "cut", *arguments))

    whole, cut = (tmp_path / name / "run" for name in ("whole", "cut"))
    assert rows(whole) == rows(cut) and "rating" in rows(whole)[-1]
    states = [checkpoint.load(checkpoint.newest_good(run)[0]) for run in (whole, cut)]
    assert_same(*(state["self_play"] for state in states))
    assert_same(*(state["matches"] for state in states))
    files = [{p.name: p.stat().st_size for p in (run / "pool").iterdir()} for run in (whole, cut)]
    assert files[0].items() <= files[1].items()  # what a kill left behind between two checkpoints may stay


# --- a game without a best pure strategy


def strategies(folder, iterations, self_play):
    """Return the learner's probabilities of rock, paper and scissors after each iteration, [n, 3]."""
    ppo = PPOConfig(
        lr=0.05,
        lr_schedule=Schedule.constant,
        entropy_coef=0.35,
        entropy_schedule=Schedule.constant,
        epochs=2,
        num_minibatches=1,
        normalize_values=ValueNormKind.none,
        normalize_advantages=False,
    )
    out = []

    def look(state):
        net = state.setup.learners["Rps"].actor[0].module
        with torch.no_grad():
            out.append(net(torch.zeros(1, 1)).softmax(-1)[0].double().numpy())

    cfg = matrix_game(iterations, games=64, ppo=ppo, self_play=self_play, checkpoint_interval=10**9)
    train(cfg, folder, after_iteration=look)
    return np.array(out)


@pytest.mark.slow
def test_newest_against_newest_goes_in_circles_and_a_pool_finds_the_equilibrium(tmp_path):
    newest = strategies(tmp_path / "newest", 160, SelfPlayConfig())[-80:]
    pool = SelfPlayConfig(save_steps=512, window=1000, swap_steps=0, num_opponents=8)
    pooled = strategies(tmp_path / "pool", 160, replace(pool, play_against_latest_model_ratio=0.2))[-80:]

    # by turns everything is the newest policy's best answer to itself
    away = np.abs(newest - EQUILIBRIUM).max(1)
    assert set(newest.argmax(1)) == {0, 1, 2} and away.mean() > 0.25 and away.max() > 0.4

    away = np.abs(pooled - EQUILIBRIUM).max(1)
    assert np.abs(pooled.mean(0) - EQUILIBRIUM).max() < 0.1 and away.mean() < 0.13 and away.max() < 0.25
