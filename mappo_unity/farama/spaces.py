"""A behavior's spaces as Gymnasium's, and its records and actions in them."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces
from mlagents_envs.base_env import ActionTuple, BehaviorSpec, DecisionSteps, ObservationSpec, TerminalSteps

from mappo_unity.errors import ConfigError
from mappo_unity.scenes.contract.images import ByteImage

CONTINUOUS, DISCRETE = "continuous", "discrete"
"""Parts of a hybrid action."""


class BehaviorSpaces:
    """The spaces of a behavior's agents.

    One sensor is a `Box`, several are a `Dict` by their names (twice the same: `NAME`, `NAME_1`). Continuous
    actions are a `Box` from -1 to 1, one branch is a `Discrete`, several are a `MultiDiscrete`, and both
    kinds together a `Dict` of `continuous` and `discrete`.
    """

    def __init__(self, name: str, spec: BehaviorSpec) -> None:
        self._name, self._actions = name, spec.action_spec
        self.keys = _sensor_names(spec.observation_specs)

        boxes: list[spaces.Space] = [_box(sensor) for sensor in spec.observation_specs]
        self.observation = boxes[0] if len(boxes) == 1 else spaces.Dict(dict(zip(self.keys, boxes)))
        self.action = _action_space(self._actions.continuous_size, self._actions.discrete_branches)

    def is_like(self, other: BehaviorSpaces) -> bool:
        """Return whether another behavior has equal spaces, its sensors in the same order."""
        if len(self.keys) > 1 and self.keys != other.keys:
            return False
        return self.observation == other.observation and self.action == other.action

    def observe(self, steps: DecisionSteps | TerminalSteps, rows: Any) -> Any:
        """Return the observations of a row, or of rows, as the space (batched for rows); copies."""
        arrays = [np.array(sensor[rows], np.float32) for sensor in steps.obs]
        return arrays[0] if len(arrays) == 1 else dict(zip(self.keys, arrays))

    def allowed(self, decision: DecisionSteps, rows: Any) -> Any:
        """Return what is allowed, 1 or 0, as `sample` of the discrete space takes it; None: no branches."""
        branches = self._actions.discrete_branches
        if not branches:
            return None

        forbidden = decision.action_mask
        if forbidden is None:
            count = len(decision)
            forbidden = [np.zeros((count, size), bool) for size in branches]
        masks = tuple((~mask[rows]).astype(np.int8) for mask in forbidden)
        return masks[0] if len(masks) == 1 else masks

    def idle(self, decision: DecisionSteps) -> ActionTuple:
        """Return what agents do that nobody plays: zeros, and the first allowed choice of each branch."""
        action = self._actions.empty_action(len(decision))
        for branch, forbidden in enumerate(decision.action_mask or []):
            action.discrete[:, branch] = np.argmin(forbidden, axis=1)
        return action

    def fill(self, action: ActionTuple, row: int, given: Any) -> None:
        """Write one agent's action into its row.

        Raises:
            ConfigError: it is not in the space.
        """
        self.write(action, [row], _batched(given), f"the action {given!r}", self.action)

    def write(self, action: ActionTuple, rows: Any, given: Any, what: str, space: spaces.Space) -> None:
        """Write batched actions into rows; `what` and `space` are for the message of a ConfigError."""
        size, branches = self._actions.continuous_size, self._actions.discrete_branches
        continuous, discrete = given, given
        try:
            if size and branches:
                continuous, discrete = given[CONTINUOUS], given[DISCRETE]

            if size:
                numbers = np.asarray(continuous, np.float32)
                _require(numbers.shape == (len(rows), size) and bool(np.isfinite(numbers).all()))
                action.continuous[rows] = np.clip(numbers, -1, 1)

            if branches:
                choices = np.asarray(discrete)
                choices = choices[:, None] if choices.ndim == 1 and len(branches) == 1 else choices
                _require(choices.shape == (len(rows), len(branches)) and choices.dtype.kind in "iu")
                _require(bool(((choices >= 0) & (choices < np.array(branches))).all()))
                action.discrete[rows] = choices
        except (TypeError, ValueError, KeyError, IndexError) as error:
            raise ConfigError(f"{self._name}: {what} is not in the action space {space}") from error


def _batched(given: Any) -> Any:
    if isinstance(given, dict):
        return {key: _batched(value) for key, value in given.items()}
    return np.asarray(given)[None]


def _require(condition: bool) -> None:
    if not condition:
        raise ValueError


def _sensor_names(sensors: list[ObservationSpec]) -> list[str]:
    names: list[str] = []
    for number, sensor in enumerate(sensors):
        name = sensor.name or f"obs_{number}"
        names.append(f"{name}_{number}" if name in names else name)
    return names


def _box(sensor: ObservationSpec) -> spaces.Box:
    if isinstance(sensor, ByteImage):
        return spaces.Box(0, 1, tuple(sensor.shape), np.float32)
    return spaces.Box(-np.inf, np.inf, tuple(sensor.shape), np.float32)


def _action_space(size: int, branches: tuple[int, ...]) -> spaces.Space:
    box = spaces.Box(-1, 1, (size,), np.float32)
    if not branches:
        return box

    choice = spaces.Discrete(branches[0]) if len(branches) == 1 else spaces.MultiDiscrete(list(branches))
    return spaces.Dict({CONTINUOUS: box, DISCRETE: choice}) if size else choice
