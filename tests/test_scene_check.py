"""The contract checker: scenes keep the contract, and each broken rule is found and named."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from mlagents_envs.base_env import ActionTuple, DecisionSteps, TerminalSteps

from mappo_unity.scenes.ball3d.scene import Ball3D
from mappo_unity.scenes.contract.check import check_env, main
from mappo_unity.scenes.contract.lifecycle import Lives
from mappo_unity.scenes.contract.play import random_actions
from mappo_unity.scenes.contract.rules import ContractError

NAME = "3DBall?team=0"
Steps = tuple[DecisionSteps, TerminalSteps]


class Broken(Ball3D):
    """3DBall whose steps are altered by `spoil` from the third call of step() on."""

    def __init__(self, spoil: Callable[[Steps], Steps], **options: Any) -> None:
        super().__init__(num_areas=3, **options)
        self.spoil = spoil
        self.calls = 0

    def step(self) -> None:
        super().step()
        self.calls += 1

    def get_steps(self, behavior_name: str) -> Steps:
        steps = super().get_steps(behavior_name)
        return self.spoil(steps) if self.calls > 2 else steps


def copied(steps: DecisionSteps) -> DecisionSteps:
    return DecisionSteps(
        [obs.copy() for obs in steps.obs], steps.reward.copy(), steps.agent_id.copy(), steps.action_mask,
        steps.group_id.copy(), steps.group_reward.copy(),
    )  # fmt: skip


def spoil_decisions(change: Callable[[DecisionSteps], None]) -> Callable[[Steps], Steps]:
    def spoil(steps: Steps) -> Steps:
        decisions = copied(steps[0])
        if len(decisions):
            change(decisions)
        return decisions, steps[1]

    return spoil


def not_finite(decisions: DecisionSteps) -> None:
    decisions.obs[0][1, 4] = np.nan


def wrong_dtype(decisions: DecisionSteps) -> None:
    decisions.reward = decisions.reward.astype(np.float64)


def repeated_id(decisions: DecisionSteps) -> None:
    decisions.agent_id[:] = 2


def wrong_shape(decisions: DecisionSteps) -> None:
    decisions.obs[0] = decisions.obs[0][:, :7]


def two_ends(steps: Steps) -> Steps:
    ended = TerminalSteps(
        [np.zeros((1, 8), np.float32)], np.zeros(1, np.float32), np.zeros(1, bool), np.array([1]),
        np.array([0]), np.zeros(1, np.float32),
    )  # fmt: skip
    return DecisionSteps.empty(Ball3D.BEHAVIORS[0].spec()), ended


def other_group(steps: Steps) -> Steps:
    _, ended = two_ends(steps)
    return steps[0], TerminalSteps(
        ended.obs, ended.reward, ended.interrupted, ended.agent_id, np.array([4]), ended.group_reward
    )


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (
            spoil_decisions(not_finite),
            r"3DBall\?team=0', agent 1: its sensor obs_0 \(VectorSensor_size8\) holds nan",
        ),
        (spoil_decisions(wrong_dtype), "DecisionSteps reward dtype float64, not float32"),
        (spoil_decisions(repeated_id), "agent 2: twice in one DecisionSteps"),
        (spoil_decisions(wrong_shape), r"shape \(3, 7\), not \(3, 8\)"),
        (two_ends, "agent 1: two terminal records without a decision between"),
        (other_group, "agent 1: ended in group 4, but its decisions were in 0"),
    ],
)
def test_broken_records_are_named(spoil: Callable[[Steps], Steps], message: str) -> None:
    with pytest.raises(ContractError, match=message):
        check_env(Broken(spoil), steps=20)


def test_accepting_actions_of_agents_that_did_not_ask_is_found() -> None:
    class Lenient(Ball3D):
        def set_action_for_agent(self, behavior_name: str, agent_id: int, action: ActionTuple) -> None:
            pass

    with pytest.raises(ContractError, match="did not ask is accepted"):
        check_env(Lenient(num_areas=2), steps=5)


def test_an_inexact_snapshot_is_found() -> None:
    class Forgetful(Ball3D):
        def load_scene_state(self, state: dict[str, Any]) -> None:
            super().load_scene_state(state)
            self.ball_spin[:] = self.counter % 7  # differs from one restore to the next
            self.ball_velocity[:] = self.rng_of_its_own.random(3)

        rng_of_its_own = np.random.default_rng(0)

    with pytest.raises(ContractError, match=r"after set_state\(\) the same actions give other records"):
        check_env(Forgetful(num_areas=2), steps=40)


def test_an_ignored_seed_is_found() -> None:
    seeds = iter(range(100))
    with pytest.raises(ContractError, match="the same seed and actions give other records"):
        check_env(Ball3D(num_areas=2), steps=40, remake=lambda: Ball3D(num_areas=2, seed=next(seeds)))


def test_an_agent_of_two_behaviors_is_found() -> None:
    lives = Lives()
    spec = Ball3D.BEHAVIORS[0].spec()
    steps = DecisionSteps.empty(spec)
    steps.agent_id, steps.group_id = np.array([3]), np.array([0])
    lives.begin_result()
    lives.ask("Big", steps)
    with pytest.raises(
        ContractError, match="Small, agent 3: asks under two behaviors at once, here and in Big"
    ):
        lives.ask("Small", steps)
    lives.begin_result()
    with pytest.raises(ContractError, match="Small, agent 3: came from Big without a terminal record"):
        lives.ask("Small", steps)


def test_an_agent_may_leave_its_group_before_it_ends() -> None:
    lives = Lives()
    spec = Ball3D.BEHAVIORS[0].spec()
    asks, ends = DecisionSteps.empty(spec), TerminalSteps.empty(spec)
    for steps, group in ((asks, 2), (ends, 0)):
        steps.agent_id, steps.group_id = np.array([3]), np.array([group])
    lives.begin_result()
    lives.ask("Crew", asks)
    lives.begin_result()
    lives.end("Crew", ends)  # as Unity's UnregisterAgent and EndEpisode send it

    lives.begin_result()
    lives.ask("Crew", asks)
    ends.group_id = np.array([5])
    with pytest.raises(ContractError, match="ended in group 5, but its decisions were in 2"):
        lives.end("Crew", ends)


def test_masks_are_obeyed_and_a_full_mask_is_an_error() -> None:
    spec = Ball3D.BEHAVIORS[0].spec()._replace()
    spec = spec._replace(action_spec=spec.action_spec.create_discrete((3,)))
    mask = np.array([[True, True, False], [True, False, True]])
    zeros = np.zeros(2, np.float32)
    steps = DecisionSteps([], zeros, np.array([5, 6]), [mask], np.array([0, 0]), zeros)
    rng = np.random.default_rng(0)
    assert random_actions(NAME, spec, steps, rng).discrete.tolist() == [[2], [1]]
    mask[1] = True
    with pytest.raises(ContractError, match="agent 6: every action of branch 0 is forbidden"):
        random_actions(NAME, spec, steps, rng)


def test_command_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["3DBall", "--steps", "200"]) == 0
    out = capsys.readouterr().out
    assert (
        "steps with ends only; checked: specs, records, errors, reset, get_state/set_state, seed, close"
        in out
    )
    assert main(["3DBall", "env.params.mass=2", "--steps", "5"]) == 0
    sampler = "env.params.mass={sampler: uniform, min: 1, max: 5}"
    assert main(["3DBall", sampler, "--steps", "5"]) == 0
    capsys.readouterr()
    for line, words in (
        ("env.params.seed=3", "use --seed=N"),
        ("env.params.num_areas=2", "use --num-areas=N"),
        ("env.params.mas=2", "mass"),
    ):
        assert main(["3DBall", line]) == 2
        assert words in capsys.readouterr().err
    assert main(["4DBall"]) == 2
    assert "choices: 3DBall" in capsys.readouterr().err


def test_a_mistake_in_a_name_names_it_once(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["os:gotcwd"]) == 2
    assert capsys.readouterr().err.startswith("os:gotcwd: os has no function 'gotcwd'")
