"""Learners in processes of their own: a batch cut by teams, states put together, resumed, lost, refused."""

from __future__ import annotations

import multiprocessing
import os
import signal
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from test_workers import SMALL, assert_same, check_resume, options

from mappo_unity import keys
from mappo_unity.cli import train_main
from mappo_unity.errors import ConfigError, EnvironmentFailure
from mappo_unity.learning.carried import VALUED
from mappo_unity.runs import checkpoint
from mappo_unity.training.run_state import RunState
from mappo_unity.training.setup import TrainingSetup, set_up
from mappo_unity.training.side_by_side.parts import Task, part_of_state, shares, whole_state
from mappo_unity.training.trainer import train

BESIDE = [
    *("env=SoccerTwos", "env.num_areas=3", "collect.rounds=12", "matches.interval=null", *SMALL),
    "ppo.num_minibatches=1",
]


# --- cutting and putting together


@pytest.mark.parametrize("sides", [None, 2])
def test_a_part_of_a_batch_is_what_its_teams_did(sides: int | None) -> None:
    rounds, teams, members = 5, 7, 2
    slots = [teams, members] if sides is None else [sides, teams, members]
    number = torch.arange(rounds * (sides or 1) * teams).view(rounds, *slots[:-1])
    entries = TensorDict({"number": number.unsqueeze(-1).expand(rounds, *slots)}, [rounds, *slots])

    # the rows that were cut off are known by their numbers
    cut_off = torch.tensor([0, 6, 7, 12, 20, 34])
    following = TensorDict(
        {
            keys.FINAL: TensorDict({"number": number[-1]}, slots[:-1]),
            keys.CUT_OFF: TensorDict({"number": cut_off}, [len(cut_off)]),
            keys.CUT_OFF_AT: cut_off - number.numel(),
        },
        [],
    )
    void = torch.zeros(*slots, 1, dtype=torch.bool)
    void[..., 3, :, :] = True

    found = []
    for part in shares(teams, 3, 0 if sides is None else 1):
        task = Task(entries, following, void, 0.5).part(part)
        own = number[..., part.begin : part.end]
        assert torch.equal(task.entries["number"][..., 0], own)
        assert torch.equal(task.following[keys.FINAL, "number"], own[-1])
        assert task.void is not None and bool(task.void.any()) is (part.begin <= 3 < part.end)

        rows = own.flatten()[task.following[keys.CUT_OFF_AT]]
        assert torch.equal(rows, task.following[keys.CUT_OFF, "number"])
        found += rows.tolist()
    assert sorted(found) == cut_off.tolist()


def test_teams_are_shared_evenly() -> None:
    assert [part.size for part in shares(7, 3, 0)] == [2, 2, 3]
    assert [(part.begin, part.end) for part in shares(4, 2, 1)] == [(0, 2), (2, 4)]


def test_states_are_cut_and_put_together() -> None:
    carried = {key: torch.rand(3, 2, 5, 2, 1) > 0.5 for key in (keys.ACTING, VALUED)} | {
        "obs": torch.rand(3, 2, 5, 2, 4)
    }
    state = {"actor": "the same", "carried": carried, "critic_states": {"value": torch.rand(2, 5, 2, 8)}}
    teams = shares(5, 3, 1)
    parts = [part_of_state(state, own) for own in teams]
    assert_same(whole_state(parts, teams), state)

    # one has less that is pending, another nothing: rounds stand before theirs in which nobody is
    parts[0]["carried"] = {key: entry[1:] for key, entry in parts[0]["carried"].items()}
    parts[2]["carried"] = None
    whole = whole_state(parts, teams)["carried"]
    assert not whole[keys.ACTING][:1, :, :1].any() and not whole[VALUED][:, :, 3:].any()
    assert torch.equal(whole["obs"][1:, :, :1], carried["obs"][1:, :, :1])
    assert torch.equal(whole[keys.ACTING][:, :, 1:3], carried[keys.ACTING][:, :, 1:3])
    for part in parts:
        part["carried"] = None
    assert whole_state(parts, teams)["carried"] is None


# --- processes


def learned(setup: TrainingSetup, batches: int) -> tuple[list[Any], dict[str, Any]]:
    """Return the metrics of some batches and the learners' states after them."""
    with setup.collecting() as endless:
        metrics = [setup.learn(next(endless), 0.1)["SoccerTwos"] for _ in range(batches)]
        return metrics, setup.learners_state()


def test_two_learners_learn_what_one_does(tmp_path: Path) -> None:
    with set_up(options(*BESIDE), tmp_path) as setup:
        (wanted,), one = learned(setup, 1)
    with set_up(options(*BESIDE, "learners=2"), tmp_path) as setup:
        (found,), two = learned(setup, 1)

    # one minibatch of everything: sums of the same numbers in another order
    for name, value in wanted.items():
        assert found[name] == pytest.approx(value, rel=2e-3, abs=2e-5), name
    state, other = one["learners"]["SoccerTwos"], two["learners"]["SoccerTwos"]
    for part in ("actor", "critic"):
        for name, value in state[part].items():
            assert torch.allclose(other[part][name], value, rtol=1e-4, atol=1e-5), name
    assert_same(other["carried"], state["carried"])
    assert len(two["generators"]) == 1 and one["generators"] is None
    assert not multiprocessing.active_children()


@pytest.mark.slow
def test_a_resumed_run_with_two_learners_is_the_whole_one(tmp_path: Path) -> None:
    check_resume(tmp_path, "env=DungeonEscape", "env.num_areas=2", "model.memory=gru", "learners=2")


@pytest.mark.slow
def test_the_number_of_learners_may_change_with_resume(tmp_path: Path) -> None:
    lines = [*BESIDE, "learners=2", f"hydra.run.dir={tmp_path}"]
    assert train_main([*lines, "max_steps=200"]) == 0
    assert train_main([f"resume={tmp_path}", "max_steps=400", "learners=1"]) == 0
    assert train_main([f"resume={tmp_path}", "max_steps=600", "learners=2"]) == 0
    newest = sorted((tmp_path / "checkpoints").glob("step_*.pt"))[-1]
    assert len(checkpoint.load(newest)["generators"]) == 1


@pytest.mark.slow
def test_a_learner_that_is_killed_ends_the_run_which_resumes(tmp_path: Path) -> None:
    def kill(state: RunState) -> None:
        if state.iteration == 2:
            (child,) = multiprocessing.active_children()
            assert child.pid is not None
            os.kill(child.pid, signal.SIGKILL)

    cfg = options(*BESIDE, "learners=2", "max_steps=100000")
    with pytest.raises(EnvironmentFailure, match="learner 1 is gone: its process ended with -9"):
        train(cfg, tmp_path, after_iteration=kill)
    newest = sorted((tmp_path / "checkpoints").glob("step_*.pt"))[-1]
    assert checkpoint.load(newest)["iteration"] == 2
    assert not multiprocessing.active_children()


# --- options


@pytest.mark.parametrize(
    ("lines", "text"),
    [
        (["learners=0"], "learners=0 is out of range: learners must be >= 1"),
        (
            ["learners=4"],
            "learners=4 is more than the teams of 'SoccerTwos', of which",
        ),
        (["learners=2", "rewards.rnd.strength=0.1"], "rewards.rnd does not go with 2 learners"),
        (
            ["learners=2", "ppo.obs_norm_update=round"],
            "ppo.obs_norm_update=round does not go with 2 learners",
        ),
    ],
)
def test_what_learners_cannot_do_is_refused(tmp_path: Path, lines: list[str], text: str) -> None:
    with pytest.raises(ConfigError) as error, set_up(options(*BESIDE, *lines), tmp_path):
        pass
    assert text in str(error.value)
