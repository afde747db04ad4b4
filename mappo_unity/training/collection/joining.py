"""The batches of several workers as one: their teams side by side, along G.

Where agents ask at their own pace, one worker needs more rounds than another. The shorter batch then begins
with rounds in which nobody acts, which nothing is learnt from; its last row is the last one of all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from mappo_unity import keys
from mappo_unity.envs.rounds import Episode
from mappo_unity.scenes.contract.statistics import join_statistics
from mappo_unity.training.collection.batches import Batch
from mappo_unity.training.collection.description import Description

_NOBODY = (keys.ACTING, keys.DEPARTED, keys.FIRST)
"""Flags that are False in a round that was put before a batch."""


def join_batches(
    batches: Sequence[Batch], parts: Sequence[Description], rounds: TensorDictBase | None = None
) -> Batch:
    """Return the batches of workers as one of the environments that they have together.

    Args:
        batches: of each worker.
        parts: what each worker has.
        rounds: the joined rounds where they lie side by side already; None: they are joined here.
    """
    length = max(batch.rounds.shape[0] for batch in batches)
    if rounds is None:
        rounds = _join_rounds([pad_rounds(batch.rounds, length) for batch in batches], parts[0])

    following = {
        name: _join_following([batch.following[name] for batch in batches], name, parts, length)
        for name in parts[0].sides
    }
    counted = [batch.restarts for batch in batches if batch.restarts is not None]
    return Batch(
        rounds,
        following,
        _join_episodes(batches, parts),
        _join_void(batches, rounds, parts),
        join_statistics([batch.statistics for batch in batches]),
        sum(counted) if counted else None,
        sum(batch.dropped_episodes for batch in batches),
        sum(batch.dropped_steps for batch in batches),
        [result for batch in batches for result in batch.results],
    )


def on_device(batch: Batch, device: str) -> Batch:
    """Return a batch of the CPU with its tensors on a device.

    From page-locked memory the rounds are copied while the CPU goes on. Workers write there again only after
    the learner's figures were read, which waits for the device.
    """
    if device == "cpu":
        return batch
    return replace(
        batch,
        rounds=batch.rounds.to(device, non_blocking=True),
        following={name: part.to(device) for name, part in batch.following.items()},
        void={name: slots.to(device) for name, slots in batch.void.items()},
    )


def pad_rounds(rounds: TensorDictBase, length: int) -> TensorDictBase:
    """Return rounds ``[T]`` behind as many in which nobody acts as make ``[length]``."""
    missing = length - rounds.shape[0]
    if not missing:
        return rounds

    # the first round again: whatever networks read there are numbers that they may read
    empty = rounds[:1].expand(missing, *rounds.shape[1:]).clone()
    for name, entries in empty.items():
        if name == "next":
            entries.zero_()
            continue
        for key in _NOBODY:
            entries.get(key).zero_()
    return torch.cat([empty, rounds], 0)


def team_dim(description: Description, name: str) -> int:
    """Return the dimension of G in a policy name's entries without T: ``[G, A]`` or ``[S, G, A]``."""
    return 1 if len(description.sides[name]) > 1 else 0


def _join_rounds(rounds: Sequence[TensorDictBase], description: Description) -> TensorDict:
    def joined(name: str, whose: Sequence[TensorDictBase]) -> TensorDictBase:
        return torch.cat([part.get(name) for part in whose], 1 + team_dim(description, name))

    following = [part.get("next") for part in rounds]
    entries = {name: joined(name, rounds) for name in description.sides}
    next_entries = {name: joined(name, following) for name in description.sides}
    size = rounds[0].batch_size
    return TensorDict(entries | {"next": TensorDict(next_entries, size)}, size)


def _join_following(
    parts: Sequence[TensorDictBase], name: str, descriptions: Sequence[Description], length: int
) -> TensorDict:
    """Return what followed the rounds of all workers; places of rows are counted in the joined rounds."""
    sides = len(descriptions[0].sides[name])
    teams = [description.teams(name) for description in descriptions]
    total, before, places = sum(teams), 0, []

    for part, own in zip(parts, teams):
        # from the end in a worker's own rounds, which stand at the end of the joined ones
        flat = part.get(keys.CUT_OFF_AT) + length * sides * own
        row, team = flat // own, flat % own
        places.append(row * total + before + team - length * sides * total)
        before += own

    at = torch.cat(places)
    order = at.argsort(stable=True)
    final = torch.cat([part.get(keys.FINAL) for part in parts], team_dim(descriptions[0], name))
    cut_off = torch.cat([part.get(keys.CUT_OFF) for part in parts])
    return TensorDict({keys.FINAL: final, keys.CUT_OFF: cut_off[order], keys.CUT_OFF_AT: at[order]}, [])


def _join_episodes(batches: Sequence[Batch], parts: Sequence[Description]) -> dict[str, list[Episode]]:
    out: dict[str, list[Episode]] = {}
    for behavior in parts[0].behaviors:
        before, joined = 0, list[Episode]()
        for batch, part in zip(batches, parts):
            joined += [episode._replace(slot=episode.slot + before) for episode in batch.episodes[behavior]]
            slots = part.behaviors[behavior].slots
            before += slots.num_teams * slots.team_size
        out[behavior] = joined
    return out


def _join_void(
    batches: Sequence[Batch], rounds: TensorDictBase, parts: Sequence[Description]
) -> dict[str, Tensor]:
    void: dict[str, Tensor] = {}
    for name in parts[0].sides:
        if not any(name in batch.void for batch in batches):
            continue
        void[name] = torch.zeros_like(rounds.get((name, keys.ACTING))[0])
        before, dim = 0, team_dim(parts[0], name)
        for batch, part in zip(batches, parts):
            if name in batch.void:
                void[name].narrow(dim, before, part.teams(name)).copy_(batch.void[name])
            before += part.teams(name)
    return void
