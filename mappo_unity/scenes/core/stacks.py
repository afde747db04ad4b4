"""Frame stacks of all agents: oldest frame first, zeros for frames not written since an end."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from mappo_unity.scenes.core.specs import Sensor


class Stacks:
    """Keep the last frames of every stacked sensor, for every agent slot."""

    def __init__(self, sensors: Iterable[Sensor], num_slots: int) -> None:
        self._frames: dict[str, np.ndarray] = {}
        for sensor in sensors:
            shape = (num_slots, sensor.stack, *sensor.shape)
            if sensor.stack == 1:
                continue
            known = self._frames.setdefault(sensor.name, np.zeros(shape, np.float32))
            assert known.shape == shape, f"two sensors named {sensor.name} differ in shape or stack"

    def push(self, sensor: Sensor, slots: np.ndarray, frame: np.ndarray) -> np.ndarray:
        """Append a frame float32 ``[n, *shape]`` for `slots` and return what the sensor now shows.

        Returns float32 ``[n, stack * shape[0], *shape[1:]]``; the frame itself for an unstacked sensor.
        """
        if sensor.stack == 1:
            return frame
        stacked = np.empty((len(slots), sensor.stack, *sensor.shape), np.float32)
        frames = self._frames[sensor.name]
        stacked[:, :-1] = frames[slots, 1:]
        stacked[:, -1] = frame
        frames[slots] = stacked
        return stacked.reshape(len(slots), -1, *sensor.shape[1:])

    def clear(self, slots: np.ndarray) -> None:
        """Zero every stack of `slots`, as the end of an episode does."""
        for frames in self._frames.values():
            frames[slots] = 0

    def get_state(self) -> dict[str, np.ndarray]:
        """Return copies of all frames by sensor name."""
        return {name: frames.copy() for name, frames in self._frames.items()}

    def set_state(self, state: dict[str, np.ndarray]) -> None:
        """Restore what `get_state` returned."""
        for name, frames in self._frames.items():
            frames[...] = state[name]
