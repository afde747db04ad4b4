"""Self-play in workers: the driver decides who plays, workers play; resumed, replaced, refused."""

import os
import shutil
import signal
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from test_self_play import GAME, GAMES, check_resume, matrix_game
from test_workers import assert_same, fleet_of

from mappo_unity import keys
from mappo_unity.cli import train_main
from mappo_unity.config.schema import CollectConfig, Engine, OpponentDraw
from mappo_unity.keys import LEARNER
from mappo_unity.runs import checkpoint
from mappo_unity.runs.rng import seed_everything
from mappo_unity.training.collection.fleet import weights_of
from mappo_unity.training.collection.lineups import Lineup, Lineups, players_of_pairs, split_players
from mappo_unity.training.run_state import RunState
from mappo_unity.training.self_play.draw import LATEST
from mappo_unity.training.setup import set_up

WORKERS = 2


def in_workers(iterations=8, engine=Engine.local, overlap=False, **changes):
    """Options of the matrix game in two workers, where every change falls into a few iterations."""
    cfg = matrix_game(iterations, checkpoint_interval=1, keep_checkpoints=20)
    steps = 2 * GAMES * WORKERS * 4
    cfg.collect = CollectConfig(batch_size=steps, workers=WORKERS, engine=engine, overlap=overlap)
    cfg.max_steps = iterations * steps
    options = {"save_steps": steps, "window": 3, "swap_steps": 0, "num_opponents": 2, "fixed": ["random"]}
    for key, value in (options | changes).items():
        setattr(cfg.self_play, key, value)
    return cfg


class Run:
    """A run without logs: `iterate` collects, learns and draws; `batch` is the last one."""

    def __init__(self, cfg, folder, resumed=None):
        self.folder = folder
        folder.mkdir(exist_ok=True)
        self.opened = set_up(cfg, folder)
        self.setup = self.opened.__enter__()
        self.state = RunState(cfg, folder, self.setup)
        if resumed is not None:
            self.state.load(resumed)
        self.collecting = self.setup.collecting()
        self.batches = self.collecting.__enter__()
        self.state.begin()

    def iterate(self):
        self.batch = next(self.batches)
        self.setup.learn(self.batch, progress=0.0)
        self.state.count(self.batch, collect_s=1.0, update_s=1.0)
        return self.state.advance_self_play(self.batch, self.batches)

    def close(self):
        self.collecting.__exit__(None, None, None)
        self.opened.__exit__(None, None, None)


def players_of(batch):
    """Who plays each team in the last round, [S, G]."""
    return batch.rounds["Rps", keys.PLAYER][-1, :, :, 0, 0]


@pytest.fixture(scope="module")
def processes(tmp_path_factory):
    cfg = in_workers(engine=Engine.processes, play_against_latest_model_ratio=0.2)
    run = Run(cfg, tmp_path_factory.mktemp("run"))
    yield run
    run.close()


def test_processes_meet_whom_workers_in_this_process_meet(processes, tmp_path):
    local = Run(in_workers(play_against_latest_model_ratio=0.2), tmp_path / "run")
    met = set()
    for step in range(5):
        metrics = []
        for run in (processes, local):
            seed_everything(step)  # learning draws, too
            metrics.append(run.iterate())
        assert_same(metrics[0], metrics[1])
        assert_same(processes.batch.rounds, local.batch.rounds)
        assert processes.batch.results == local.batch.results and local.batch.results
        assert processes.batch.episodes == local.batch.episodes

        players = players_of(local.batch)
        assert players.shape == (2, WORKERS * GAMES)
        assert ((players == LEARNER).sum(0) >= 1).all()  # of two teams that meet one learns, or both do
        met |= set(players.flatten().tolist())
    # past policies, and the fixed opponent
    assert {LEARNER, 0, LATEST - 1} < met
    assert_same(processes.state.self_play.state_dict(), local.state.self_play.state_dict())
    assert metrics[0]["Self-play/ELO"] != 1200.0 and metrics[0]["pool_size"] == 4
    local.close()


def test_what_was_on_its_way_is_played_by_the_same_again_and_then_comes_who_was_drawn_behind_it(
    processes, tmp_path
):
    self_play, fleet, policy = processes.state.self_play, processes.setup.fleet, processes.setup.policy
    processes.iterate()
    fleet.request(weights_of(policy), want_state=True)
    self_play._draw()  # as at the end of an iteration, with overlap
    assert fleet.opposing <= self_play._used()
    checkpoint.save(tmp_path / "state.pt", processes.state.state_dict())

    cfg = in_workers(play_against_latest_model_ratio=0.2)
    cfg.collect.overlap = True
    shutil.copytree(processes.folder, tmp_path / "run")
    resumed = Run(cfg, tmp_path / "run", tmp_path / "state.pt")
    seen = []
    for is_on_its_way in (True, False):
        if not is_on_its_way:
            fleet.request(weights_of(policy), want_state=True)
        resumed.setup.fleet.request(weights_of(policy), want_state=True)
        batches = [each.receive() for each in (resumed.setup.fleet, fleet)]
        assert_same(batches[0].rounds, batches[1].rounds)
        seen.append(players_of(batches[0]))
    assert not torch.equal(*seen)
    resumed.close()


@pytest.mark.slow
def test_a_worker_that_is_replaced_meets_the_pool_again(processes):
    for killed_between in (True, False):
        fleet = fleet_of(processes.setup)
        lost = fleet.processes[1].pid
        if not killed_between:  # it is lost with the request, and the lineup that comes before it
            processes.batches._request()
        os.kill(lost, signal.SIGKILL)
        processes.iterate()
        assert fleet.processes[1].pid != lost
        own = set(players_of(processes.batch)[:, GAMES:].flatten().tolist()) - {LEARNER}
        assert own and own <= fleet._lineups.sent.networks.keys()


OVERLAP = pytest.param({"overlap": True, "engine": Engine.processes}, marks=pytest.mark.slow)


@pytest.mark.parametrize("changes", [{}, {"team_change": 300, "opponents": OpponentDraw.hardest}, OVERLAP])
def test_a_resumed_run_meets_whom_it_would_have_met(tmp_path, changes):
    cfg = in_workers(play_against_latest_model_ratio=0.2, **changes)
    first = check_resume(cfg, tmp_path)
    assert first["iteration"] > 6 and first["self_play"]["draws"] > 4
    assert (first["workers"][1]["opponents"]["playing"]["Rps"] != LEARNER).any()


def test_a_snapshot_that_is_missing_is_left_out_in_workers_too(tmp_path, capsys):
    run = tmp_path / "run"
    lines = [*GAME, "collect.workers=2", "collect.engine=local", f"hydra.run.dir={run}"]
    lines += ["self_play.play_against_latest_model_ratio=0", "env.params.games=16"]
    assert train_main([*lines, "max_steps=256"]) == 0
    for file in sorted((run / "pool").iterdir())[:-1]:
        file.unlink()
    capsys.readouterr()
    assert train_main([f"resume={run}", "max_steps=400", "self_play.skip_missing=true"]) == 0
    said = capsys.readouterr().out
    assert said.count("an opponent of the pool is left out") >= 2 and "finished" in said


# --- what travels


def lineup(players, numbers, kept):
    networks = {number: {"A": {"weight": torch.tensor([float(number)])}} for number in numbers}
    return Lineup(tuple({"A": torch.tensor(own)} for own in players), networks, frozenset(kept))


def test_a_network_travels_once():
    lineups = Lineups()
    assert lineups.next(behind=False) is None and lineups.sent is None and lineups.numbers == set()

    lineups.decide(lineup([[0, LEARNER], [1, 1]], [0, 1], kept=[0, 1, 2]))
    assert lineups.next(behind=False).networks.keys() == {0, 1}
    assert lineups.next(behind=False) is None  # nothing has changed
    assert lineups.numbers == {0, 1}

    lineups.decide(lineup([[2, LEARNER], [1, 1]], [1, 2], kept=[1, 2]))
    told = lineups.next(behind=False)
    assert told.networks.keys() == {2} and told.players[0]["A"].tolist() == [2, LEARNER]
    assert lineups.sent.networks.keys() == {1, 2}  # all of it, for a worker that is replaced

    # what is not kept is sent again where it plays again
    lineups.decide(lineup([[0, LEARNER], [1, 1]], [0, 1], kept=[0, 1, 2]))
    assert lineups.next(behind=False).networks.keys() == {0}


def test_what_a_new_worker_has_not_got_travels_again():
    lineups = Lineups()
    for number in (0, 1):
        lineups.decide(lineup([[number]], [number], kept=[0, 1]))
        assert lineups.next(behind=False).networks.keys() == {number}

    lineups.forget()  # a worker was replaced, and told `sent`
    lineups.decide(lineup([[0], [1]], [0, 1], kept=[0, 1]))
    assert lineups.next(behind=False).networks.keys() == {0}


def test_the_lineup_of_a_batch_that_was_on_its_way_comes_before_the_one_that_was_decided():
    before = Lineups()
    before.decide(lineup([[0]], [0], kept=[0]))
    before.next(behind=False)

    lineups = Lineups()
    lineups.load_state_dict(before.state_dict())
    assert lineups.numbers == {0}
    lineups.decide(lineup([[1]], [0, 1], kept=[0, 1]))
    first, second = lineups.next(behind=True), lineups.next(behind=False)
    assert first.players[0]["A"].tolist() == [0] and first.networks.keys() == {0, 1}
    assert second.players[0]["A"].tolist() == [1] and not second.networks


def part(teams):
    """What a worker has, with so many teams by behavior."""
    behaviors = {name: SimpleNamespace(slots=SimpleNamespace(num_teams=n)) for name, n in teams.items()}
    return SimpleNamespace(behaviors=behaviors, sides={name.partition("?")[0]: [name] for name in teams})


def test_two_who_are_drawn_as_a_pair_meet_also_where_sides_have_different_numbers_of_teams():
    parts = [part({"A?team=0": 1, "B?team=1": 2}), part({"A?team=0": 2, "B?team=1": 1})]
    # pairs 0 and 1 are the first worker's, and nobody of A is in the second of them
    drawn = {"A?team=0": np.array([10, 11, 12, 13]), "B?team=1": np.array([20, 21, 22, 23])}
    players = players_of_pairs(drawn, parts)
    assert {name: own.tolist() for name, own in players.items()} == {"A": [10, 12, 13], "B": [20, 21, 22]}

    first, second = split_players(players, parts)
    assert {name: own.tolist() for name, own in first.items()} == {"A": [10], "B": [20, 21]}
    assert {name: own.tolist() for name, own in second.items()} == {"A": [12, 13], "B": [22]}


def test_sides_take_turns_only_where_the_next_batch_waits_for_it(tmp_path, capsys):
    lines = ["env=SoccerTwos", "collect.workers=2", "collect.overlap=true", "self_play.save_steps=100"]
    assert train_main([*lines, "self_play.team_change=500", f"hydra.run.dir={tmp_path}"]) == 2
    said = capsys.readouterr().err
    assert "self_play.team_change=500 does not go with collect.overlap=true" in said and said.count("\n") == 1
