"""A batch, and what learners keep of its slots, by teams: cut along G for several learners, put together.

Legend: D, the dimension of G in a policy name's entries without T, ``[G, A]`` or ``[S, G, A]``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from mappo_unity import keys
from mappo_unity.learning.carried import VALUED
from mappo_unity.learning.ppo import PolicyLearner

CARRIED, STATES = "carried", "critic_states"
"""What a learner's state holds of every slot: tensors ``[P, ..., G, A, ...]``, and ``[..., G, A, n]``."""
_FLAGS = (keys.ACTING, keys.FIRST, VALUED)


class Teams(NamedTuple):
    """The teams of a policy name that one of several learners learns from."""

    begin: int
    end: int
    dim: int  # D

    @property
    def size(self) -> int:
        """How many they are."""
        return self.end - self.begin


@dataclass(frozen=True)
class Task:
    """What a learner is to learn.

    Attributes:
        entries: of its policy name, ``[T, ..., A]``, with their own ``next``.
        following: what was seen after them, see `keys.FINAL`, `keys.CUT_OFF` and `keys.CUT_OFF_AT`.
        void: bool ``[..., A, 1]``, slots of which nothing is pending any more; None: there are none.
        progress: share of the run that is over, 0 to 1, for the schedules.
    """

    entries: TensorDictBase
    following: TensorDictBase
    void: Tensor | None
    progress: float

    def part(self, teams: Teams) -> Task:
        """Return some teams' part of it, in memory of its own."""
        entries = _of(self.entries, 1, teams)
        void = None if self.void is None else _of(self.void, 0, teams)
        return Task(entries, _following_of(self.following, self.entries, teams), void, self.progress)

    def to(self, device: str) -> Task:
        """Return it with its tensors on a device."""
        void = None if self.void is None else self.void.to(device)
        return Task(self.entries.to(device), self.following.to(device), void, self.progress)


def learn(learners: Mapping[str, PolicyLearner], tasks: Mapping[str, Task]) -> dict[str, dict[str, float]]:
    """Let learners learn by their policy names; return the metrics of each."""
    metrics = {}
    for name, task in tasks.items():
        if task.void is not None:
            learners[name].carried.void(task.void)
        metrics[name] = learners[name].learn(task.entries, task.following, task.progress)
    return metrics


def shares(total: int, learners: int, dim: int) -> list[Teams]:
    """Return the teams of each of several learners, as evenly as they go."""
    ends = [total * number // learners for number in range(learners + 1)]
    return [Teams(begin, end, dim) for begin, end in zip(ends, ends[1:])]


def part_of_state(state: Mapping[str, Any], teams: Teams) -> dict[str, Any]:
    """Return a learner's state with what it keeps of some teams alone."""
    carried, states = state[CARRIED], state.get(STATES, {})
    if carried is not None:
        carried = {key: _of(entry, 1, teams) for key, entry in carried.items()}
    return {**state, CARRIED: carried, STATES: {name: _of(each, 0, teams) for name, each in states.items()}}


def whole_state(parts: Sequence[Mapping[str, Any]], teams: Sequence[Teams]) -> dict[str, Any]:
    """Return the first learner's state with what all of them keep of their teams.

    Args:
        parts: the states of all learners, of which only `CARRIED` and `STATES` are read but for the first.
        teams: of each.
    """
    dim = teams[0].dim
    states = {
        name: torch.cat([part[STATES][name].to(first.device) for part in parts], dim)
        for name, first in parts[0][STATES].items()
    }
    return {**parts[0], CARRIED: _whole_carried([part[CARRIED] for part in parts], teams), STATES: states}


def _whole_carried(
    parts: Sequence[dict[str, Tensor] | None], teams: Sequence[Teams]
) -> dict[str, Tensor] | None:
    """Return carried rounds side by side; the shorter ones begin with rounds in which nobody is pending."""
    some = [part for part in parts if part is not None]
    if not some:
        return None
    length = max(len(part[VALUED]) for part in some)
    padded = [_padded(part, some[0], own, length) for part, own in zip(parts, teams)]

    def side_by_side(key: str, device: torch.device) -> Tensor:
        return torch.cat([part[key].to(device) for part in padded], 1 + teams[0].dim)

    return {key: side_by_side(key, entry.device) for key, entry in some[0].items()}


def _padded(
    part: dict[str, Tensor] | None, like: dict[str, Tensor], teams: Teams, length: int
) -> dict[str, Tensor]:
    """Return carried rounds ``[length, ...]`` of some teams."""
    missing = length - (0 if part is None else len(part[VALUED]))
    if part is not None and not missing:
        return part

    out = {}
    for key, entry in (part or like).items():
        # any round of any team: whatever networks read there are numbers that they may read
        one = entry[:1].narrow(1 + teams.dim, 0, 1)
        shape = [missing, *one.shape[1:]]
        shape[1 + teams.dim] = teams.size
        empty = one.expand(shape)
        if key in _FLAGS:
            empty = torch.zeros_like(empty)
        out[key] = empty if part is None else torch.cat([empty, entry], 0)
    return out


def _of(entries: Any, before: int, teams: Teams) -> Any:
    """Return some teams' entries, in memory of their own; `before` dimensions stand before D's."""
    place = (slice(None),) * (before + teams.dim) + (slice(teams.begin, teams.end),)
    return entries[place].clone()


def _following_of(following: TensorDictBase, entries: TensorDictBase, teams: Teams) -> TensorDict:
    """Return what followed some teams' rows; places of rows are counted in their own entries."""
    total = entries.shape[1 + teams.dim]
    sides = entries.shape[1] if teams.dim else 1
    rows = entries.shape[0] * sides

    # places count from the end, see `keys.CUT_OFF_AT`
    flat = following.get(keys.CUT_OFF_AT) + rows * total
    row, team = flat // total, flat % total
    mine = (team >= teams.begin) & (team < teams.end)
    at = row[mine] * teams.size + team[mine] - teams.begin - rows * teams.size

    final = _of(following.get(keys.FINAL), 0, teams)
    return TensorDict(
        {keys.FINAL: final, keys.CUT_OFF: following.get(keys.CUT_OFF)[mine], keys.CUT_OFF_AT: at}, []
    )
