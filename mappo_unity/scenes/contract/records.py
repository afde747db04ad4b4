"""What a BaseEnv must send: decision and terminal steps that fit its behaviors.

Whoever reads records checks them here: the adapter in every step, evaluation, and the contract checker. What
breaks a rule is an `EnvironmentDataError` that names the behavior, the agent and the rule.
"""

from __future__ import annotations

from typing import Any, NoReturn, TypeAlias

import numpy as np
from mlagents_envs.base_env import BehaviorSpec, DecisionSteps, TerminalSteps

from mappo_unity.scenes.contract.rules import LISTS, EnvironmentDataError, sensor_name, show_kind

FLOAT32, BOOL = np.dtype(np.float32), np.dtype(bool)

Steps: TypeAlias = DecisionSteps | TerminalSteps


class RecordCheck:
    """Check what `get_steps` returns for one behavior.

    Called in every step, so that what is right costs a few microseconds; only what looks wrong is looked at
    closely. Numbers of another type than ML-Agents' own (float64 rewards, masks of 0 and 1) are converted.

    Args:
        name: the behavior's full name.
        spec: what `behavior_specs` says of it.
    """

    def __init__(self, name: str, spec: BehaviorSpec) -> None:
        self.name, self.spec = name, spec
        self._shapes = [tuple(sensor.shape) for sensor in spec.observation_specs]
        self._branches = list(spec.action_spec.discrete_branches)
        self._unique: dict[type, bytes] = {}  # the newest ids without a repetition

    def __call__(self, result: Any) -> tuple[DecisionSteps, TerminalSteps]:
        """Return the decision and terminal steps of a result.

        Raises:
            EnvironmentDataError: shapes, types or ids are wrong, a number is not finite, or every action of a
                branch is masked.
        """
        is_pair = isinstance(result, LISTS) and len(result) == 2
        if not (is_pair and isinstance(result[0], DecisionSteps) and isinstance(result[1], TerminalSteps)):
            got = f"({', '.join(type(part).__name__ for part in result)})" if is_pair else show_kind(result)
            raise EnvironmentDataError(
                f"behavior {self.name!r}: get_steps returned {got}; it must return the pair "
                "(DecisionSteps, TerminalSteps), for no agents DecisionSteps.empty(spec) and "
                "TerminalSteps.empty(spec)"
            )

        return self._checked(result[0]), self._checked(result[1])

    def _checked(self, steps: Any) -> Any:
        """Return decision or terminal steps, converted where their types were not ML-Agents' own."""
        try:
            count = len(steps.agent_id)
            fits = self._fits(steps, count) if count else not any(map(len, steps.obs))
        except (AttributeError, TypeError):  # something is no array
            fits = False
        if not fits:
            steps = Repair(self.name, self.spec, steps).converted()
            count = len(steps.agent_id)

        if count:
            self._check_ids(steps)
            self._check_numbers(steps)
        return steps

    def _fits(self, steps: Any, count: int) -> bool:
        """Whether all arrays have the shapes and types of ML-Agents' own."""
        ids, groups, reward, group_reward = steps.agent_id, steps.group_id, steps.reward, steps.group_reward
        if not ids.shape == groups.shape == reward.shape == group_reward.shape == (count,):
            return False
        if not (ids.dtype.kind == groups.dtype.kind == "i" and reward.dtype == group_reward.dtype == FLOAT32):
            return False

        if isinstance(steps, TerminalSteps):
            if steps.interrupted.shape != (count,) or steps.interrupted.dtype != BOOL:
                return False
        elif steps.action_mask is not None:
            masks = [(mask.shape, mask.dtype) for mask in steps.action_mask]
            if masks != [((count, size), BOOL) for size in self._branches]:
                return False

        sensors = [(obs.shape, obs.dtype) for obs in steps.obs]
        return sensors == [((count, *shape), FLOAT32) for shape in self._shapes]

    def _check_ids(self, steps: Steps) -> None:
        """Refuse ids that stand twice in a result, and negative ones (which stand for free places here)."""
        # Mostly the same agents request again: equal ids were looked at already.
        seen = steps.agent_id.tobytes()
        if seen == self._unique.get(type(steps)):
            return

        ids = steps.agent_id.tolist()
        if len(set(ids)) < len(ids):
            twice = next(agent for row, agent in enumerate(ids) if agent in ids[:row])
            raise EnvironmentDataError(
                f"behavior {self.name!r}, agent {twice}: twice in one {_kind(steps)}; every agent has an id "
                "of its own, and one row in a result"
            )
        if min(ids) < 0:
            raise EnvironmentDataError(
                f"behavior {self.name!r}, agent {min(ids)}: ids of agents must be >= 0"
            )

        self._unique[type(steps)] = seen

    def _check_numbers(self, steps: Any) -> None:
        """Refuse numbers that are not finite, and masks that forbid everything."""
        for index, obs in enumerate(steps.obs):
            if np.count_nonzero(np.isfinite(obs)) < obs.size:
                self._refuse(steps, obs, f"sensor {sensor_name(self.spec, index)}")

        for what, values in (("reward", steps.reward), ("group reward", steps.group_reward)):
            if np.count_nonzero(np.isfinite(values)) < values.size:
                self._refuse(steps, values, what)

        if isinstance(steps, DecisionSteps):
            for branch, forbidden in enumerate(steps.action_mask or []):
                full = forbidden.all(axis=1)
                if np.count_nonzero(full):
                    agent = int(steps.agent_id[int(np.argmax(full))])
                    raise EnvironmentDataError(
                        f"behavior {self.name!r}, agent {agent}: every action of discrete branch {branch} is "
                        "masked; at least one action of a branch must be allowed (in a mask True = forbidden)"
                    )

    def _refuse(self, steps: Steps, values: np.ndarray, what: str) -> None:
        row = int(np.argwhere(~np.isfinite(values))[0][0])
        value = values[row][~np.isfinite(values[row])].flat[0] if values.ndim > 1 else values[row]
        kind = "decision" if isinstance(steps, DecisionSteps) else "terminal"

        raise EnvironmentDataError(
            f"behavior {self.name!r}, agent {int(steps.agent_id[row])}: its {what} holds {value} in a {kind} "
            "step; every number that an environment sends must be finite"
        )


class Repair:
    """Say what is wrong with decision or terminal steps that do not fit, or convert what is harmless."""

    def __init__(self, name: str, spec: BehaviorSpec, steps: Any) -> None:
        self.name, self.spec, self.steps = name, spec, steps

    def converted(self) -> Steps:
        """Return the steps with numbers as float32, flags as bool.

        Raises:
            EnvironmentDataError: an array is missing, or its shape or type is wrong.
        """
        steps = self.steps
        ids = self._array("agent_id", steps.agent_id, None, "iu", np.int64, "a whole number for each agent")
        count = (len(ids),)
        each = f"{len(ids)} agents (agent_id) have one each"

        groups = self._array("group_id", steps.group_id, count, "iu", np.int64, f"{each}, 0 = alone")
        reward = self._array("reward", steps.reward, count, "fiub", FLOAT32, each)
        group_reward = self._array(
            "group_reward", steps.group_reward, count, "fiub", FLOAT32, f"{each}, zeros without groups"
        )

        obs = self._observations(len(ids))
        if isinstance(steps, TerminalSteps):
            flags = f"{each}, True = time limit"
            interrupted = self._array("interrupted", steps.interrupted, count, "b", BOOL, flags)
            return TerminalSteps(obs, reward, interrupted, ids, groups, group_reward)

        return DecisionSteps(obs, reward, ids, self._masks(len(ids)), groups, group_reward)

    def _observations(self, count: int) -> list[np.ndarray]:
        sensors, given = self.spec.observation_specs, self.steps.obs
        if not isinstance(given, LISTS) or len(given) != len(sensors):
            got = f"{len(given)} arrays" if isinstance(given, LISTS) else show_kind(given)
            self._fail("obs", got, f"a list of {len(sensors)}, an array for each sensor of behavior_specs")

        return [
            self._array(
                f"sensor {sensor_name(self.spec, index)}",
                values,
                (count, *sensor.shape),
                "fiub",
                FLOAT32,
                f"a row for each of {count} agents (agent_id), of the sensor's shape in behavior_specs",
            )
            for index, (sensor, values) in enumerate(zip(sensors, given, strict=True))
        ]

    def _masks(self, count: int) -> list[np.ndarray] | None:
        branches, given = self.spec.action_spec.discrete_branches, self.steps.action_mask
        if given is None:
            return None

        if not isinstance(given, LISTS) or len(given) != len(branches):
            got = f"{len(given)} arrays" if isinstance(given, LISTS) else show_kind(given)
            wanted = f"None, or a list of {len(branches)}, an array for each discrete branch"
            self._fail("action_mask", got, wanted)

        each = f"a flag for each of {count} agents (agent_id) and each action, True = forbidden"
        return [
            self._array(f"action_mask of branch {branch}", values, (count, size), "biu", BOOL, each)
            for branch, (size, values) in enumerate(zip(branches, given, strict=True))
        ]

    def _array(
        self, what: str, values: Any, shape: tuple[int, ...] | None, kinds: str, dtype: Any, why: str
    ) -> np.ndarray:
        """Return `values` as this type; `shape` None: any with one dimension; `kinds` can be converted."""
        if not isinstance(values, np.ndarray):
            self._fail(what, show_kind(values), f"a NumPy array: {why}")
        if values.ndim != 1 if shape is None else values.shape != shape:
            raise EnvironmentDataError(
                f"{self._head(what)} shape {values.shape}, not {shape or '(n,)'}: {why}"
            )
        if values.dtype.kind not in kinds:
            raise EnvironmentDataError(
                f"{self._head(what)} dtype {values.dtype}, not {np.dtype(dtype).name}: {why}"
            )

        with np.errstate(over="ignore"):  # what becomes infinite is refused as that
            return np.asarray(values, dtype)

    def _head(self, what: str) -> str:
        return f"behavior {self.name!r}: {_kind(self.steps)} {what} has"

    def _fail(self, what: str, got: str, wanted: str) -> NoReturn:
        raise EnvironmentDataError(
            f"behavior {self.name!r}: {_kind(self.steps)} {what} is {got}; it must be {wanted}"
        )


def _kind(steps: Steps) -> str:
    return "DecisionSteps" if isinstance(steps, DecisionSteps) else "TerminalSteps"
