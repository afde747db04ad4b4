"""Episodes that a failed player cut off: they leave the batch and the statistics, and training goes on."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from fakes import Record, ScriptedEnv, behavior_spec

from mappo_unity.cli import train_main
from mappo_unity.envs.unity_env import UnityEnv
from mappo_unity.errors import ConfigError, EnvironmentFailure
from mappo_unity.policies.episodes import play
from mappo_unity.policies.policy import RandomPolicy
from mappo_unity.runs import checkpoint
from mappo_unity.scenes import make_scene
from mappo_unity.training.collection.crashed_episodes import episode_rows, mask_crashed_episodes
from mappo_unity.training.collection.worker import make_collector

FAKE = "Fake?team=0"


class Fragile(ScriptedEnv):
    """A scripted environment whose result number `breaks_at` is that of a restarted player."""

    breaks_at = 0
    cut: tuple[int, ...] = ()

    @property
    def restarts(self) -> int:
        return int(self.at >= self.breaks_at)

    @property
    def crashed_agents(self) -> dict[str, np.ndarray]:
        return {FAKE: np.array(self.cut, np.int32)} if self.at == self.breaks_at else {}


def fragile(script: list[list[Record]], breaks_at: int, cut: tuple[int, ...]) -> UnityEnv:
    env = Fragile(script)
    env.breaks_at, env.cut = breaks_at, cut
    return UnityEnv(lambda seed: env)


def idle(env: UnityEnv, rounds: int) -> Any:
    """Collect a batch with random actions."""
    return env.rollout(rounds, break_when_any_done=False)


def test_rows_of_an_episode_reach_back_to_the_one_before() -> None:
    done = torch.tensor([[0, 0], [1, 0], [0, 0], [0, 0], [1, 1], [0, 0]], dtype=torch.bool)
    rows = episode_rows(done, 4, torch.tensor([True, False]))
    assert rows[:, 0].tolist() == [False, False, True, True, True, False] and not rows[:, 1].any()
    assert episode_rows(done, 4, torch.tensor([True, True]))[:, 1].tolist() == [True] * 5 + [False]


def test_slots_follow_the_batch_to_its_device() -> None:
    # tensors on "meta" mix with those on the CPU as little as those on a GPU do
    done = torch.zeros(6, 2, dtype=torch.bool, device="meta")
    assert episode_rows(done, 4, torch.tensor([True, False])).device == done.device


def test_a_cut_episode_neither_counts_nor_is_learned_from() -> None:
    # Agent 0 ends by itself in result 1; the player fails in result 3 and takes both agents' episodes along.
    script = [
        [Record(0), Record(1)],
        [Record(0, ends="terminated", reward=5), Record(0), Record(1, reward=1)],
        [Record(0, reward=1), Record(1, reward=1)],
        [Record(0, ends="interrupted"), Record(1, ends="interrupted"), Record(0), Record(1)],
        [Record(0, reward=2), Record(1, reward=2)],
        [Record(0, ends="terminated", reward=3), Record(0), Record(1, reward=2)],
    ]
    env = fragile(script, 3, (0, 1))
    batch = idle(env, 5)
    cuts = env.pop_crashed_episodes()
    assert [(c.round, c.behavior, c.slots.ravel().tolist()) for c in cuts] == [(2, FAKE, [True, True])]
    assert not env.pop_crashed_episodes()
    assert env.restarts == 1
    finished = env.pop_episodes()[FAKE]
    assert [(e.individual_return, e.length) for e in finished] == [(5, 1), (5, 2)]
    truncated = batch["next", "Fake", "truncated"].reshape(5, 2)
    assert truncated.tolist() == [[False] * 2] * 2 + [[True, True]] + [[False] * 2] * 2
    # row t holds the decisions of result t: agent 0's cut episode is rows 1 and 2, agent 1's rows 0 to 2
    assert mask_crashed_episodes(batch, cuts, env)[0] == 2 + 3
    assert batch["Fake", "acting"].reshape(5, 2).T.tolist() == [
        [True, False, False, True, True],
        [False, False, False, True, True],
    ]


def test_evaluation_plays_another_episode_for_one_that_was_cut_off() -> None:
    env = Fragile(
        [
            [Record(0), Record(1)],
            [Record(0, reward=1), Record(1, reward=1)],
            [Record(0, ends="interrupted"), Record(1, ends="interrupted"), Record(0), Record(1)],
            [Record(0, ends="terminated", reward=3), Record(0), Record(1, reward=1)],
            [Record(0), Record(1, ends="terminated", reward=4), Record(1)],
        ]
    )
    env.breaks_at, env.cut = 2, (0, 1)
    episodes = play(env, RandomPolicy(0), 2)[FAKE]
    assert [(e.agent_id, e.individual_return, e.length) for e in episodes] == [(0, 3, 1), (1, 5, 2)]


def test_evaluation_begins_another_one_though_some_episodes_did_not_count() -> None:
    env = Fragile(
        [
            [Record(0), Record(1)],
            [Record(0, ends="interrupted"), Record(1, ends="interrupted"), Record(0), Record(1)],
            [Record(0, ends="terminated", reward=3), Record(0), Record(1)],
        ]
    )
    env.breaks_at, env.cut = 1, (0, 1)
    (episode,) = play(env, RandomPolicy(0), 1)[FAKE]  # agent 1's was the second one begun
    assert (episode.agent_id, episode.individual_return) == (0, 3)


def test_a_behavior_that_a_player_shows_late_is_refused() -> None:
    env = fragile([[Record(0)]] * 5, 99, ())
    env.base_env.specs["Late?team=0"] = behavior_spec()
    start, cure = "appeared after the start, when there were .'Fake", "request a decision in the first step"
    with pytest.raises(ConfigError, match=f"'Late.team=0' {start}.* every behavior must {cure} after"):
        idle(env, 1)


def test_an_environment_without_players_has_no_restarts() -> None:
    assert UnityEnv(lambda seed: ScriptedEnv([[Record(0)]])).restarts is None


def test_drops_reach_batches_of_the_collector() -> None:
    """The collector's batch is changed in place, whatever way it is stored."""
    from mappo_unity.envs.transforms import transformed

    env = fragile([[Record(0, reward=1), Record(1, reward=1)]] * 12, 99, ())
    collector = make_collector(transformed(env), None, 5)  # type: ignore[arg-type]
    batches = iter(collector)
    next(batches)
    base: Any = env.base_env
    base.breaks_at, base.cut = 8, (1,)
    base.script[8] = [Record(1, ends="interrupted"), Record(0), Record(1)]
    batch = next(batches)
    dropped, void = mask_crashed_episodes(batch, env.pop_crashed_episodes(), env)
    assert dropped == 3  # results 5, 6 and 7 are rows 0 to 2 of the second batch
    assert void["Fake"].flatten().tolist() == [False, True]  # its episode had begun in the first
    assert batch["Fake", "acting"].reshape(5, 2).T.tolist() == [[True] * 5, [False] * 3 + [True] * 2]
    collector.shutdown()


def failing_factory(seed: int, steps: int) -> Any:
    """Return 3DBall that is restarted once, and fails for good after `steps` steps."""
    scene = make_scene("3DBall", seed=seed, num_areas=6)
    step = scene.step
    count = 0

    def counted() -> None:
        nonlocal count
        count += 1
        if count > steps:
            raise EnvironmentFailure("player Game failed: killed by SIGKILL; its log: Player-0.log")
        scene.restarts = int(count > 30)
        step()

    scene.step = counted
    scene.restarts, scene.crashed_agents = 0, {}
    return scene


def test_past_the_limit_there_is_a_checkpoint_and_exit_code_3(tmp_path: Path, capsys: Any) -> None:
    code = train_main(
        [
            "env=custom",
            "env.factory=test_drops:failing_factory",
            "env.params.steps=100",
            "collect.rounds=20",
            "ppo.minibatch_size=60",
            "model.hidden=[16]",
            "log.loggers=[csv]",
            "log.progress=false",
            "export_onnx=false",
            f"output_dir={tmp_path}",
            f"hydra.run.dir={tmp_path}/run",
        ]
    )
    assert code == 3
    captured = capsys.readouterr()
    assert "mappo-train: player Game failed: killed by SIGKILL; its log: Player-0.log" in captured.err
    assert "Traceback" not in captured.err
    path, warnings = checkpoint.newest_good(tmp_path / "run")
    with open(tmp_path / "run" / "metrics.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert checkpoint.load(path)["agent_steps"] == int(rows[-1]["agent_steps"]) > 0 and not warnings
    assert [float(row["restarts"]) for row in rows[:1]] == [0] and float(rows[-1]["restarts"]) == 1


def test_runs_without_players_have_no_such_columns(tmp_path: Path) -> None:
    from test_train import options

    from mappo_unity.training.run_state import RunState
    from mappo_unity.training.setup import set_up

    with set_up(options(1), tmp_path) as setup, setup.collecting() as batches:
        assert RunState(options(1), tmp_path, setup).count_crashed(next(batches)) == {}
