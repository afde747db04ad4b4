"""What a sensor says of itself beside its shape: entities of varying number, and goal signals."""

from __future__ import annotations

from mlagents_envs.base_env import DimensionProperty, ObservationSpec, ObservationType


def is_set(sensor: ObservationSpec) -> bool:
    """Tell whether a sensor is rows ``[N, F]`` of which any number is there (Unity's BufferSensor)."""
    flags = [bool(flag & DimensionProperty.VARIABLE_SIZE) for flag in sensor.dimension_property or ()]
    return len(sensor.shape) == 2 and flags == [True, False]


def is_goal(sensor: ObservationSpec) -> bool:
    """Tell whether a sensor is a goal signal: what the agent is to do, not what it sees."""
    return sensor.observation_type == ObservationType.GOAL_SIGNAL
