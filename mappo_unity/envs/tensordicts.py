"""The arrays of a behavior's slots as TensorDicts ``[G, A]``, entries as `keys` names them."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from tensordict import TensorDict

from mappo_unity import keys
from mappo_unity.envs.rounds import BehaviorState


def slot_shape(behavior: BehaviorState) -> torch.Size:
    """Return ``[G, A]``, teams and members of a team."""
    return torch.Size((behavior.slots.num_teams, behavior.slots.team_size))


def root_entries(behavior: BehaviorState) -> TensorDict:
    """Return what the agents are to act on now: entries as `reset` gives them, ends all False."""
    shape = slot_shape(behavior)
    # copies, because the behavior goes on writing into its newest observations
    entries = _observe(behavior, [o.copy() for o in behavior.obs], behavior.present, behavior.departed)

    for key in (keys.DONE, keys.TERMINATED, keys.TRUNCATED):
        entries[key] = torch.zeros((*shape, 1), dtype=torch.bool)
    return unchecked(entries, shape)


def next_entries(behavior: BehaviorState) -> TensorDict:
    """Return what the last round brought: last observations, rewards and ends.

    Of a slot whose episode ended it says who was there then, not who holds the slot now.
    """
    shape = slot_shape(behavior)
    entries = _observe(behavior, behavior.end_obs, behavior.end_present, behavior.end_departed)

    # no copies: `begin_round` makes new arrays
    for key, values in (
        (keys.REWARD, behavior.reward),
        (keys.GROUP_REWARD, behavior.group_reward),
        (keys.TERMINATED, behavior.terminated),
        (keys.TRUNCATED, behavior.truncated),
        (keys.DONE, behavior.terminated | behavior.truncated),
    ):
        entries[key] = torch.from_numpy(values.reshape(*shape, 1))
    return unchecked(entries, shape)


def _observe(
    behavior: BehaviorState, observations: list[np.ndarray], present: np.ndarray, departed: np.ndarray
) -> dict[str, torch.Tensor]:
    """Return the entries of the sensors, of the slots' flags, and the action mask where there is one."""
    shape = slot_shape(behavior)
    entries = {
        keys.SENSOR.format(i): torch.from_numpy(o.reshape(*shape, *o.shape[1:]))
        for i, o in enumerate(observations)
    }

    # copies, because flags are written in place in later rounds
    for key, flags in (
        (keys.ACTING, behavior.acting),
        (keys.PRESENT, present),
        (keys.DEPARTED, departed),
        (keys.FIRST, behavior.first),
    ):
        entries[key] = torch.from_numpy(flags.reshape(*shape, 1).copy())

    if behavior.mask.shape[1]:
        entries[keys.MASK] = torch.from_numpy(behavior.mask.reshape(*shape, -1).copy())
    return entries


def unchecked(entries: dict[str, Any], shape: torch.Size, device: torch.device | None = None) -> TensorDict:
    """Return entries that are known to fit a shape as a TensorDict.

    The checks of TensorDict's constructor take ten times as long as its work, several times a round.
    """
    return TensorDict._new_unsafe(entries, shape, device)
