"""A demonstration as the tensors that networks read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from mappo_unity import keys
from mappo_unity.learning.networks.distributions import CONTINUOUS_LIMIT
from mappo_unity.learning.transitions import Transitions
from mappo_unity.protocol.demos.demonstration import Demonstration


@dataclass(frozen=True)
class Expert:
    """N decisions whose action is known, one whole episode after the other.

    Attributes:
        steps: the decisions, their actions as our networks draw them (continuous ones 3 times the recorded).
        first: bool ``[N]``, first decisions of their episodes.
        mask: bool ``[N, sum of branches]``, True = allowed; None: all are.
    """

    steps: Transitions
    first: Tensor
    mask: Tensor | None

    def __len__(self) -> int:
        return len(self.steps)


def make_expert(demo: Demonstration, obs_keys: Sequence[str], device: str) -> Expert:
    """Return a demonstration's decisions for networks that read these entries.

    Args:
        demo: of the behavior that the networks play.
        obs_keys: see `ObsLayout.keys`.
        device: of the networks.
    """

    def tensor(values: np.ndarray) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(values)).to(device)

    # where the file does not say what was done there is nothing to learn
    known = np.flatnonzero(demo.has_action)
    rows = demo.rows[known]
    sensors = [frame.astype(np.float32, copy=False) for frame in demo.frames]
    vectors = [frame for frame in sensors if frame.ndim == 2]
    others = {keys.SENSOR.format(i): frame for i, frame in enumerate(sensors) if frame.ndim > 2}
    table = [np.concatenate(vectors, -1) if key == keys.OBS else others[key] for key in obs_keys]

    parts = [demo.continuous[known] * CONTINUOUS_LIMIT] if demo.continuous.shape[1] else []
    parts += [demo.discrete[known]] if demo.discrete.shape[1] else []
    steps = Transitions(
        [tensor(entry) for entry in table],
        tensor(rows),
        tensor(rows + 1),
        tensor(np.concatenate(parts, -1).astype(np.float32 if demo.continuous.shape[1] else np.int64)),
        tensor(demo.done[known]),
    )
    # an episode whose first decision was left out begins with the next one
    episode = np.cumsum(demo.first)[known]
    first = np.diff(episode, prepend=-1) != 0
    return Expert(steps, tensor(first), None if demo.mask is None else tensor(_with_taken(demo, known)))


def _with_taken(demo: Demonstration, known: np.ndarray) -> np.ndarray:
    """Return the masks of decisions, which allow what was done: Unity's heuristics need not heed them.

    The likelihood of an action that is forbidden would be 0, and its logarithm teaches nothing.
    """
    assert demo.mask is not None
    mask = demo.mask[known].copy()
    starts = np.cumsum([0, *demo.spec.action_spec.discrete_branches[:-1]])
    mask[np.arange(len(known))[:, None], demo.discrete[known] + starts] = True
    return mask
