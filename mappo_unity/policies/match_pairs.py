"""Which episodes of the two sides are one match, told from all episodes that ended while they played.

An environment does not say which agents share an area. The two sides of a match end in the same step,
though, and where matches of several areas do, both sides end in the same order.
"""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence

from mappo_unity.policies.episodes import Ended


def other_returns(own: Sequence[Ended], other: Sequence[Ended]) -> Mapping[int, float]:
    """Return what the other side earned in the matches that our episodes ended.

    Args:
        own, other: all episodes of a behavior of each side, in the order of their ends.

    Returns:
        The other side's return, the mean of several agents without a team, by the `id` of our episode.
        Missing are matches whose sides did not end together, and those with a reward earned before them, as
        by a ball that scores twice.
    """
    rivals, found = _ends(other), dict[int, float]()
    for step, rows in _ends(own).items():
        ours, theirs = len(rows), len(rivals.get(step, ()))
        # as many on both sides, or as many agents of one for each of the other
        if not theirs or (ours % theirs and theirs % ours):
            continue

        for index, row in enumerate(rows):
            first = index * theirs // ours
            end = max(first + 1, (index + 1) * theirs // ours)
            others = rivals[step][first:end]
            if not any(one.is_late for one in (row, *others)):
                found[id(row.episode)] = statistics.fmean(map(_earned, others))

    return found


def _ends(ended: Sequence[Ended]) -> dict[int, list[Ended]]:
    """Return the episodes that ended a match, by step: those of agents alone, and the last of a team's."""
    ends: dict[int, list[Ended]] = {}
    has_teams = any(row.episode.group_id for row in ended)
    later: dict[int, int] = {}  # when the earliest of a team's episodes began that ended later
    seen: set[tuple[int, int]] = set()

    for row in reversed(ended):
        group, ended_at = row.episode.group_id, row.ended_at
        if has_teams:
            # a mate that played on, or ended in this step, speaks for the team
            is_last = later.get(group, ended_at) >= ended_at and (ended_at, group) not in seen
            later[group] = min(row.began_at, later.get(group, row.began_at))
            seen.add((ended_at, group))
            if not group or not is_last:
                continue
        ends.setdefault(ended_at, []).insert(0, row)

    return ends


def _earned(row: Ended) -> float:
    episode = row.episode
    return episode.group_return if episode.group_id else episode.individual_return
