"""The framework rules of `scenes.base`, on a scripted scene, against hand-worked timelines.

Tick t of a run is the t-th call of `simulate`, from 0; the decision period is 5, so decisions fall on ticks
0, 5, 10 ... An event in `act` or `simulate` of tick k is sent in tick k + 1.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from mlagents_envs.base_env import ActionTuple
from mlagents_envs.exception import UnityActionException, UnityEnvironmentException

from mappo_unity.errors import ConfigError
from mappo_unity.scenes.core.scene import Scene
from mappo_unity.scenes.core.specs import Behavior, Parameter, Sensor

CLOCK = Sensor("Clock", (1,), stack=3)
OWN = Sensor("Own", (2,))
A, B = "A?team=0", "B?team=1"
Script = dict[tuple[str, int], Callable[["Toy"], None]]


class Toy(Scene):
    """Two areas of three agents: two of behavior A in a group, one of B in a group of its own."""

    NAME = "Toy"
    DEFAULT_NUM_AREAS = 2
    BEHAVIORS = (
        Behavior(A, (CLOCK, OWN), continuous=1, branches=(3, 2)),
        Behavior(B, (CLOCK,), branches=(4,)),
    )
    AREA_BEHAVIORS = (0, 0, 1)
    AREA_GROUPS = (0, 0, 1)
    PARAMETERS = {"size": Parameter(1.0, above=0.0)}

    def __init__(self, script: Script | None = None, **options: Any) -> None:
        super().__init__(**options)
        self.script = script or {}
        self.tick = 0
        self.begun: list[tuple[int, list[int]]] = []
        self.acted: list[tuple[int, list[int], list[float]]] = []
        self.noise = np.zeros(self.num_slots)

    def begin_episode(self, slots: np.ndarray) -> None:
        self.begun.append((self.tick, slots.tolist()))
        self.noise[slots] = self.rng.random(len(slots))

    def observe(self, behavior: int, slots: np.ndarray) -> list[np.ndarray]:
        clock = np.full((len(slots), 1), self.tick + 1, np.float32)  # never 0, to tell it from padding
        own = np.stack([slots, self.noise[slots]], axis=1).astype(np.float32)
        return [clock, own][: len(self.BEHAVIORS[behavior].sensors)]

    def fixed_update(self) -> None:
        self._run("fixed_update")

    def act(self, slots: np.ndarray) -> None:
        self.acted.append((self.tick, slots.tolist(), self.agents.continuous[slots, 0].tolist()))
        self.add_reward(slots, 1.0)
        self._run("act")

    def controllers(self) -> None:
        self._run("controllers")

    def simulate(self) -> None:
        self._run("simulate")
        self.tick += 1

    def scene_state(self) -> dict[str, Any]:
        return {"tick": self.tick, "noise": self.noise.copy()}

    def load_scene_state(self, state: dict[str, Any]) -> None:
        self.tick = state["tick"]
        self.noise[:] = state["noise"]

    def _run(self, hook: str) -> None:
        self.script.get((hook, self.tick), lambda scene: None)(self)


def slots(*numbers: int) -> np.ndarray:
    return np.array(numbers)


def ids(env: Scene, name: str) -> tuple[list[int], list[int]]:
    decisions, terminals = env.get_steps(name)
    return decisions.agent_id.tolist(), terminals.agent_id.tolist()


def started(script: Script | None = None, **options: Any) -> Toy:
    env = Toy(script, **options)
    env.reset()
    return env


def test_layout_of_ids_and_groups() -> None:
    env = started()
    a, b = env.get_steps(A)[0], env.get_steps(B)[0]
    assert a.agent_id.tolist() == [0, 1, 3, 4] and b.agent_id.tolist() == [2, 5]
    assert a.group_id.tolist() == [1, 1, 3, 3] and b.group_id.tolist() == [2, 4]
    assert list(env.behavior_specs) == [A, B]
    assert env.behavior_specs[A].observation_specs[0].name == "StackingSensor_size3_Clock"
    assert env.behavior_specs[A].observation_specs[0].shape == (3,)
    assert a.obs[0].shape == (4, 3) and a.obs[1].shape == (4, 2)
    assert [mask.shape for mask in a.action_mask] == [(4, 3), (4, 2)]
    assert not a.action_mask[0].any()


def test_a_window_sums_five_ticks_and_reset_begins_every_episode_once() -> None:
    env = started()
    assert env.begun == [(0, [0, 1, 2, 3, 4, 5])]
    assert env.get_steps(A)[0].reward.tolist() == [0, 0, 0, 0]
    env.step()
    assert env.tick == 5
    assert env.get_steps(A)[0].reward.tolist() == [5, 5, 5, 5]
    assert env.get_steps(A)[0].reward.dtype == np.float32


def test_stacks_are_oldest_first_and_zero_after_an_end() -> None:
    env = started({("act", 7): lambda scene: scene.end_episode(slots(1))})
    assert env.get_steps(A)[0].obs[0].tolist() == [[0, 0, 1]] * 4
    env.step()
    assert env.get_steps(A)[0].obs[0].tolist() == [[0, 1, 6]] * 4
    env.step()  # the end of tick 7 comes alone, in tick 8
    decisions, terminals = env.get_steps(A)
    assert env.tick == 8 and len(decisions) == 0
    assert terminals.obs[0].tolist() == [[1, 6, 8]]  # the terminal frame enters the stack
    env.step()
    assert env.get_steps(A)[0].obs[0].tolist() == [[1, 6, 11], [0, 0, 11], [1, 6, 11], [1, 6, 11]]


def test_terminal_record_and_zero_action_until_the_next_decision() -> None:
    env = started({("act", 2): lambda scene: scene.end_episode(slots(0))})
    env.set_actions(A, ActionTuple(np.full((4, 1), 0.5, np.float32), np.ones((4, 2), np.int32)))
    env.step()
    _, terminals = env.get_steps(A)
    assert terminals.agent_id.tolist() == [0] and terminals.reward.tolist() == [3]  # ticks 0, 1, 2
    assert terminals.interrupted.tolist() == [False] and terminals.group_id.tolist() == [1]
    env.step()
    assert env.get_steps(A)[0].reward.tolist() == [2, 5, 5, 5]  # ticks 3 and 4 with the zero action
    assert [action[0] for _, _, action in env.acted] == [0.5, 0.5, 0.5, 0, 0]
    assert [action[1] for _, _, action in env.acted] == [0.5] * 5
    assert env.agents.step_count[:2].tolist() == [3, 6]  # ticks 3, 4, 5 and ticks 0 to 5


def test_without_actions_between_decisions_act_runs_in_decision_ticks_only() -> None:
    class Once(Toy):
        TAKE_ACTIONS_BETWEEN_DECISIONS = False

    env = Once()
    env.reset()
    env.step()
    env.step()
    assert [tick for tick, _, _ in env.acted] == [0, 5]


def test_end_in_the_last_tick_of_a_window_comes_with_the_next_decision() -> None:
    env = started({("simulate", 4): lambda scene: scene.end_episode(slots(3))})
    env.step()
    assert env.tick == 5 and ids(env, A) == ([0, 1, 3, 4], [3])
    assert env.get_steps(A)[1].reward.tolist() == [5]
    assert env.get_steps(A)[0].reward.tolist() == [5, 5, 0, 5]


def test_second_end_sends_nothing_keeps_its_reward_and_begins_again() -> None:
    def second(scene: Toy) -> None:
        scene.set_reward(slots(0), -1.0)
        scene.end_episode(slots(0))

    env = started({("act", 1): lambda scene: scene.end_episode(slots(0)), ("simulate", 3): second})
    env.step()
    env.step()
    assert env.tick == 5 and ids(env, A) == ([0, 1, 3, 4], [])
    assert env.get_steps(A)[0].reward.tolist() == [0, 5, 5, 5]  # -1 replaced, then tick 4 added 1
    assert env.begun[1:] == [(1, [0]), (3, [0])]


def test_end_before_the_first_decision_of_an_agent_is_sent() -> None:
    env = started({("fixed_update", 0): lambda scene: scene.switch_behavior(slots(0, 1, 3, 4), 0)})
    assert ids(env, A) == ([0, 1, 3, 4], [0, 1, 3, 4])


def test_max_step_interrupts() -> None:
    class Short(Toy):
        MAX_STEP = 7

    env = Short()
    env.reset()
    env.step()
    env.step()  # tick 6 is the seventh
    assert env.tick == 7 and ids(env, A) == ([], [0, 1, 3, 4])
    assert env.get_steps(A)[1].interrupted.all() and env.get_steps(B)[1].interrupted.all()
    assert env.get_steps(A)[1].reward.tolist() == [2, 2, 2, 2]


def test_group_reward_and_group_end() -> None:
    def goal(scene: Toy) -> None:
        scene.add_group_reward(slots(0, 1), 0.25)
        scene.add_group_reward(slots(2), -1.0)
        scene.end_episode(slots(2))
        scene.end_episode(slots(0, 1))

    env = started({("simulate", 1): goal})
    env.step()
    a, b = env.get_steps(A)[1], env.get_steps(B)[1]
    assert a.agent_id.tolist() == [0, 1] and a.group_reward.tolist() == [0.25, 0.25]
    assert b.agent_id.tolist() == [2] and b.group_reward.tolist() == [-1.0]
    env.step()
    assert env.get_steps(A)[0].group_reward.tolist() == [0, 0, 0, 0]


def test_disabled_agent_leaves_its_group_and_returns_under_a_new_id() -> None:
    def back(scene: Toy) -> None:
        scene.add_group_reward(slots(0, 1), 1.0)
        scene.enable(slots(0), scene.home_groups()[slots(0)])

    env = started({("simulate", 1): lambda scene: scene.disable(slots(0)), ("simulate", 6): back})
    env.step()
    terminals = env.get_steps(A)[1]
    assert terminals.agent_id.tolist() == [0] and terminals.group_id.tolist() == [1]
    assert terminals.interrupted.tolist() == [False]
    assert env.begun == [(0, [0, 1, 2, 3, 4, 5])]  # no new episode while disabled
    env.step()
    assert ids(env, A) == ([1, 3, 4], [])
    env.step()
    decisions = env.get_steps(A)[0]
    assert decisions.agent_id.tolist() == [1, 3, 4, 6]  # ascending ids; slot 0 is agent 6 now
    assert decisions.group_id.tolist() == [1, 3, 3, 1]
    assert decisions.group_reward.tolist() == [1, 0, 0, 0]
    assert decisions.reward.tolist() == [5, 5, 5, 3]  # enabled after tick 6: ticks 7, 8, 9
    assert decisions.obs[0][3].tolist() == [0, 0, 11]
    assert decisions.obs[1][:, 0].tolist() == [1, 3, 4, 0]
    assert env.begun[1] == (6, [0])


def test_actions_follow_the_rows_after_ids_have_changed() -> None:
    def swap(scene: Toy) -> None:
        scene.disable(slots(0))
        scene.enable(slots(0), 1)

    env = started({("simulate", 1): swap})
    env.step()
    env.step()
    assert ids(env, A)[0] == [1, 3, 4, 6]
    env.set_actions(A, ActionTuple(np.array([[0.1], [0.3], [0.4], [0.6]]), np.zeros((4, 2), np.int32)))
    env.step()
    acted = dict(zip(env.acted[-1][1], env.acted[-1][2], strict=True))
    assert [acted[slot] for slot in (0, 1, 3, 4)] == pytest.approx([0.6, 0.1, 0.3, 0.4])


def test_agent_moves_to_another_behavior() -> None:
    env = started({("fixed_update", 7): lambda scene: scene.switch_behavior(slots(2), 0)})
    env.step()
    env.step()
    assert env.tick == 7 and ids(env, A) == ([], []) and ids(env, B) == ([], [2])
    assert env.get_steps(B)[1].reward.tolist() == [2]  # ticks 5 and 6
    assert not env.get_steps(B)[1].interrupted.any()
    env.step()
    assert ids(env, A) == ([0, 1, 2, 3, 4], []) and ids(env, B) == ([5], [])
    assert len(env.begun) == 1  # no episode begins by a switch


def test_switch_after_an_end_sends_no_second_terminal() -> None:
    env = started(
        {
            ("simulate", 2): lambda scene: scene.end_episode(slots(2)),
            ("fixed_update", 3): lambda scene: scene.switch_behavior(slots(2), 0),
        }
    )
    env.step()
    assert env.tick == 3 and ids(env, B) == ([], [2])
    env.step()
    assert env.tick == 5 and ids(env, A)[0] == [0, 1, 2, 3, 4] and ids(env, B) == ([5], [])


def test_later_reset_is_one_tick_old_and_silent() -> None:
    env = started({("act", 6): lambda scene: scene.end_episode(slots(4))})
    env.step()
    env.step()  # terminal of agent 4 in tick 7
    env.set_actions(A, ActionTuple(np.zeros((0, 1)), np.zeros((0, 2), np.int32)))
    env.reset()
    assert env.begun[-1] == (7, [0, 1, 2, 3, 4, 5])
    assert env.acted[-1] == (7, [0, 1, 2, 3, 4, 5], [0.0] * 6)  # the running tick ends with zero actions
    decisions, terminals = env.get_steps(A)
    assert env.tick == 8 and env.counter == 1 and len(terminals) == 0
    assert decisions.reward.tolist() == [3, 3, 3, 1]  # ticks 5, 6, 7 are not cleared; agent 4: tick 7
    assert decisions.obs[0].tolist() == [[1, 6, 9]] * 3 + [[0, 0, 9]]  # stacks are not cleared
    assert env.agents.step_count.tolist() == [1] * 6
    env.step()
    assert env.tick == 13


def test_staggered_agents_act_by_their_own_rhythm() -> None:
    class Staggered(Toy):
        def decides(self) -> bool | np.ndarray:
            return (self.counter + np.arange(self.num_slots)) % 2 == 0

    env = Staggered()
    env.reset()
    assert ids(env, A)[0] == [0, 4] and ids(env, B)[0] == [2]
    env.step()
    assert ids(env, A)[0] == [1, 3] and ids(env, B)[0] == [5]
    with pytest.raises(IndexError, match="agent 0 of A"):
        env.set_action_for_agent(A, 0, ActionTuple(np.zeros((1, 1)), np.zeros((1, 2), np.int32)))


def test_unset_actions_are_zero_and_one_agent_can_be_set() -> None:
    env = started()
    env.set_actions(A, ActionTuple(np.ones((4, 1)), np.ones((4, 2), np.int32)))
    env.step()
    assert env.acted[-1][1:] == ([0, 1, 2, 3, 4, 5], [1, 1, 0, 1, 1, 0])
    env.set_action_for_agent(A, 3, ActionTuple(np.full((1, 1), 0.5), np.array([[2, 1]], np.int32)))
    assert env.agents.discrete[3].tolist() == [2, 1]
    env.step()
    assert env.acted[-1][2] == [0, 0, 0, 0.5, 0, 0]


def test_wrong_actions_names_and_order_of_calls_are_refused() -> None:
    env = Toy()
    with pytest.raises(UnityActionException, match="call reset"):
        env.get_steps(A)
    env.reset()
    with pytest.raises(UnityActionException, match=r"no behavior 'C'; it has \['A\?team=0', 'B\?team=1'\]"):
        env.get_steps("C")
    with pytest.raises(UnityActionException, match="continuous input of dimension"):
        env.set_actions(A, ActionTuple(np.zeros((3, 1)), np.zeros((3, 2), np.int32)))
    with pytest.raises(UnityActionException, match=r"agent 3 of A\?team=0 is invalid"):
        env.set_actions(A, ActionTuple(np.array([[0], [0], [np.nan], [0]]), np.zeros((4, 2), np.int32)))
    for index in (4, -1):
        with pytest.raises(UnityActionException, match=r"agent 2 of B\?team=1 .* branches \[4\]"):
            env.set_actions(B, ActionTuple(discrete=np.array([[index], [0]])))
    env.close()
    with pytest.raises(UnityEnvironmentException, match="closed"):
        env.step()


def test_actions_are_copied_when_set() -> None:
    env = started()
    continuous = np.ones((4, 1), np.float32)
    env.set_actions(A, ActionTuple(continuous, np.zeros((4, 2), np.int32)))
    continuous[:] = 0.25
    env.step()
    assert env.acted[-1][2][0] == 1.0


def test_snapshot_repeats_to_the_bit_with_new_ids_stacks_and_pending_actions() -> None:
    script: Script = {
        ("simulate", 1): lambda scene: scene.disable(slots(0)),
        ("simulate", 6): lambda scene: scene.enable(slots(0), 1),
        ("act", 11): lambda scene: scene.end_episode(slots(1, 2, 5)),
        ("fixed_update", 13): lambda scene: scene.switch_behavior(slots(5), 0),
    }
    env = started(script)
    env.step()
    env.step()
    env.set_action_for_agent(A, 1, ActionTuple(np.full((1, 1), 0.75), np.ones((1, 2), np.int32)))
    state = env.get_state()
    runs = []
    for other in (env, Toy(script, seed=9)):
        other.set_state(state)
        trace = [other.get_steps(A), other.get_steps(B)]
        for _ in range(5):
            other.step()
            trace += [other.get_steps(A), other.get_steps(B)]
        runs.append((trace, other.agents.get_state(), other.rng.random()))
    (one, agents, drawn), (two, agents_two, drawn_two) = runs
    assert drawn == drawn_two and agents["next_id"] == agents_two["next_id"] == 7
    for mine, his in zip(one, two, strict=True):
        for left, right in zip(mine, his, strict=True):
            assert left.agent_id.tolist() == right.agent_id.tolist()
            assert left.reward.tolist() == right.reward.tolist()
            assert all((x == y).all() for x, y in zip(left.obs, right.obs, strict=True))
    with pytest.raises(ConfigError, match="num_areas=2, this scene num_areas=3"):
        Toy(num_areas=3).set_state(state)


def test_options_are_checked() -> None:
    assert Toy(size=2.0).parameters == {"size": 2.0}
    with pytest.raises(ConfigError, match="no parameter 'weight'; choices: size"):
        Toy(weight=2.0)
    with pytest.raises(ConfigError, match="size=0.0 of scene Toy is out of range: it must be > 0"):
        Toy().set_parameter("size", 0.0)
    with pytest.raises(ConfigError, match="size=big of scene Toy must be a finite number"):
        Toy(size="big")
    with pytest.raises(ConfigError, match="num_areas=0 must be"):
        Toy(num_areas=0)
    with pytest.raises(ConfigError, match="seed=-1 must be"):
        Toy(seed=-1)
