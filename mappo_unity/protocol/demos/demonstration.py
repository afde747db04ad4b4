"""What one or several recordings hold, a row a decision, and whether it fits a behavior."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from mlagents_envs.base_env import BehaviorSpec

from mappo_unity.errors import ConfigError


@dataclass(frozen=True)
class Demonstration:
    """N decisions of one behavior, one whole episode after the other, with what followed each of them.

    An episode's last frame, at its end, is no decision: it is the last decision's `next_obs` alone.

    Continuous actions are as the environment takes them, from -1 to 1. Those of our networks and buffers are
    3 times as large (`learning.networks.distributions.CONTINUOUS_LIMIT`): multiply before you compare.
    """

    source: str
    """The file or files, for messages."""
    behavior: str
    """Name of the behavior that was recorded, with or without its team."""
    spec: BehaviorSpec
    """Its sensors and actions."""
    frames: list[np.ndarray]
    """Every observation, those at the ends of episodes too: of each sensor float32 ``[R, *shape]``."""
    rows: np.ndarray
    """int64 ``[N]``: in which frame a decision was taken; the frame behind it is what followed."""
    continuous: np.ndarray
    """float32 ``[N, C]``: continuous actions."""
    discrete: np.ndarray
    """int32 ``[N, K]``: index of the action in each branch."""
    has_action: np.ndarray
    """bool ``[N]``: False where the file does not say what was done, and the action is only likely."""
    mask: np.ndarray | None
    """bool ``[N, sum of branches]``, True = allowed; None: none was recorded."""
    reward: np.ndarray
    """float32 ``[N]``: what the agent earned from the decision to the next one or the end."""
    group_reward: np.ndarray
    """float32 ``[N]``: what its group earned, likewise."""
    done: np.ndarray
    """bool ``[N]``: the episode ended then, for good or by a time limit."""
    interrupted: np.ndarray
    """bool ``[N]``: it ended by a time limit, or the recording did: the value of `next_obs` still counts."""
    first: np.ndarray
    """bool ``[N]``: the decision is its episode's first; sequences for a memory are cut there."""

    def __len__(self) -> int:
        return len(self.rows)

    def obs(self, which: Any = slice(None)) -> list[np.ndarray]:
        """Return what the agent saw at decisions: of each sensor float32 ``[n, *shape]``.

        `which`: indices of decisions; all of them unless given.
        """
        return [frame[self.rows[which]] for frame in self.frames]

    def next_obs(self, which: Any = slice(None)) -> list[np.ndarray]:
        """Return what the agent saw when the next decision was due, or at the end, as `obs` does."""
        return [frame[self.rows[which] + 1] for frame in self.frames]

    @property
    def returns(self) -> np.ndarray:
        """Sum of rewards and group rewards of each episode, float64; the last one may have no end."""
        rewards = self.reward.astype(np.float64) + self.group_reward
        return np.add.reduceat(rewards, np.flatnonzero(self.first))


def joined(parts: Sequence[Demonstration]) -> Demonstration:
    """Return demonstrations of one behavior as one, in their order.

    Raises:
        ConfigError: sensors or actions differ.
    """
    head = parts[0]
    if len(parts) == 1:
        return head
    for part in parts[1:]:
        different = _differences(part.spec, head.spec, "the other's")
        if different:
            raise ConfigError(
                f"demonstrations {head.source} and {part.source} cannot be joined: in the second, "
                + "; ".join(different)
            )

    starts = np.cumsum([0] + [len(part.frames[0]) for part in parts[:-1]])
    columns = {
        name: np.concatenate([getattr(part, name) for part in parts])
        for name in (
            *("continuous", "discrete", "has_action", "reward", "group_reward", "done", "interrupted"),
            "first",
        )
    }
    return Demonstration(
        source=", ".join(part.source for part in parts),
        behavior=head.behavior,
        spec=head.spec,
        frames=[np.concatenate(frames) for frames in zip(*[part.frames for part in parts])],
        rows=np.concatenate([part.rows + start for part, start in zip(parts, starts)]),
        mask=_joined_masks(parts),
        **columns,
    )


def check_matches(demo: Demonstration, spec: BehaviorSpec, behavior: str) -> None:
    """Raise ConfigError, with every difference, unless a behavior has a demonstration's sensors and actions.

    Names of behaviors and sensors may differ, as for ML-Agents.
    """
    different = _differences(demo.spec, spec, f"{behavior}'s")
    if different:
        raise ConfigError(
            f"demonstration {demo.source} does not fit the behavior {behavior!r}: in the demonstration, "
            + "; ".join(different)
        )


def _differences(spec: BehaviorSpec, wanted: BehaviorSpec, whose: str) -> list[str]:
    """Return what a spec has otherwise than `wanted`, which is `whose`."""
    found = []
    shapes, others = ([tuple(s.shape) for s in side.observation_specs] for side in (spec, wanted))
    if len(shapes) != len(others):
        found.append(f"there are {len(shapes)} sensors with shapes {shapes}, {whose} are {others}")
    else:
        found += [
            f"sensor obs_{index} has shape {shape}, {whose} has {other}"
            for index, (shape, other) in enumerate(zip(shapes, others))
            if shape != other
        ]

    size, other_size = spec.action_spec.continuous_size, wanted.action_spec.continuous_size
    if size != other_size:
        found.append(f"actions have {size} continuous columns, {whose} have {other_size}")
    sizes, other_sizes = (tuple(map(int, side.action_spec.discrete_branches)) for side in (spec, wanted))
    if sizes != other_sizes:
        found.append(f"discrete branches have sizes {sizes}, {whose} have {other_sizes}")
    return found


def _joined_masks(parts: Sequence[Demonstration]) -> np.ndarray | None:
    if all(part.mask is None for part in parts):
        return None
    total = sum(parts[0].spec.action_spec.discrete_branches)
    # where none was recorded, all is allowed
    masks = [part.mask if part.mask is not None else np.ones((len(part), total), bool) for part in parts]
    return np.concatenate(masks)
