"""The rows that an update draws its minibatches from: team rows, or, if recurrent, sequences of one agent."""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor

from mappo_unity import keys
from mappo_unity.config.schema import PPOConfig
from mappo_unity.learning.decisions import DecisionView
from mappo_unity.learning.loss import ACTOR_LEARNS, BASELINE, CRITIC_LEARNS, MEMBER, PROXIMAL, TEAM
from mappo_unity.learning.networks.recurrent import RecurrentCritic
from mappo_unity.learning.sequences import cut_sequences

_LEARNT = (ACTOR_LEARNS, CRITIC_LEARNS, PROXIMAL, keys.ADVANTAGE, keys.VALUE_TARGET, keys.VALUE, BASELINE)
_PIECE = 4096  # decisions that are read at once: images of a whole batch would not fit into memory
_ROUND, _TEAM_ROW, _VALID = "round", "team_row", "valid"


Read = Callable[[TensorDictBase], Tensor]
"""What the loss reads, as `take` returns it, to a number for each decision or several, ``[..., n]``."""


class TeamRows:
    """Team rows ``[R, A]`` in which anybody learns.

    Args:
        row_keys: entries that the networks read or wrote.
        shuffles: take the members of each minibatch in an order of its own.
    """

    def __init__(self, row_keys: list[str], shuffles: bool = False) -> None:
        self._keys, self._shuffles = row_keys, shuffles

    def of(self, rounds: TensorDict, view: DecisionView) -> tuple[TensorDictBase, Tensor]:
        """Return the rows, and how many decisions each holds, int64 ``[R]``."""
        used = [key for key in (*self._keys, *_LEARNT) if key in rounds.keys()]
        rows = rounds.select(*used).flatten(0, -2)
        decisions = rows.get(ACTOR_LEARNS).sum((-2, -1))

        # rows without an action to learn from would only dilute the minibatches
        learns = decisions > 0
        if not bool(learns.all()):
            rows, decisions = rows[learns], decisions[learns]

        # masks that hide nothing only cost time
        if bool((decisions == rows.shape[-1]).all()):
            rows = rows.exclude(ACTOR_LEARNS, CRITIC_LEARNS)
        return rows, decisions

    def fill(self, rounds: TensorDict, view: DecisionView, key: str, read: Read) -> None:
        """Set an entry ``[R, ..., A, n]`` of the rounds to what is read of their rows, piece by piece."""
        rows = rounds.select(*self._keys).flatten(0, -2)
        pieces = rows.split(max(1, _PIECE // rounds.shape[-1]))
        rounds.set(key, torch.cat([read(piece) for piece in pieces]).view(*rounds.shape, -1))

    def forget(self) -> None:
        """Keep nothing of a batch."""

    def take(self, minibatch: TensorDictBase) -> TensorDictBase:
        """Return what the loss reads."""
        if not self._shuffles:
            return minibatch
        return minibatch[:, random_order(minibatch.get(keys.ADVANTAGE), dim=1)]


class SequenceRows:
    """Sequences ``[B, L]`` of single agents' decisions.

    Args:
        row_keys: entries that the networks read or wrote.
        critic_keys: those that the critic reads.
        critic: the critic.
        cfg: `sequence_length`, `shuffle_members`.
    """

    def __init__(
        self, row_keys: list[str], critic_keys: list[str], critic: RecurrentCritic, cfg: PPOConfig
    ) -> None:
        self._critic, self._length, self._shuffles = critic, cfg.sequence_length, cfg.shuffle_members
        self._critic_keys = critic_keys
        self._keys = [key for key in row_keys if key not in (keys.MEMORY, keys.PRESENT, keys.DEPARTED)]
        self._rounds: dict[str, Tensor] = {}  # [T, G, A, ...] of all sides

    def forget(self) -> None:
        """Let go of the rounds of the last batch, images too, which has been learnt."""
        self._rounds = {}

    def of(self, rounds: TensorDict, view: DecisionView) -> tuple[TensorDictBase, Tensor]:
        """Return where the sequences stand, and how many decisions each holds, int64 ``[B]``."""
        learns = rounds.get(ACTOR_LEARNS)
        # those of departed members, too: only the critic learns there
        flat = [rounds.get(key).cpu().numpy().reshape(len(rounds), -1) for key in (keys.FIRST, CRITIC_LEARNS)]
        found = cut_sequences(view, flat[0], flat[1], self._length)

        # sides and teams become one dimension
        self._rounds = {
            str(key): entry.flatten(1, rounds.batch_dims - 2) if rounds.batch_dims > 2 else entry.unsqueeze(1)
            for key, entry in rounds.items()
        }
        team_size = rounds.shape[-1]
        device = learns.device
        rounds_at, slots, valid = (
            torch.from_numpy(array).to(device) for array in (found.rounds, found.slots, found.valid)
        )
        rows = {_ROUND: rounds_at, _TEAM_ROW: slots // team_size, MEMBER: slots % team_size, _VALID: valid}
        sequences = TensorDict(rows, rounds_at.shape[:1])
        own = self._own(ACTOR_LEARNS, sequences).squeeze(-1) & valid
        return sequences, own.sum(-1)

    def fill(self, rounds: TensorDict, view: DecisionView, key: str, read: Read) -> None:
        """Set an entry ``[R, ..., A, n]`` of the rounds to what is read of their sequences, piece by piece.

        It is 0 where no sequence stands; there is one at least.
        """
        sequences, _ = self.of(rounds, view)
        at, valid = sequences.get(_ROUND), sequences.get(_VALID)
        pieces = sequences.split(max(1, _PIECE // at.shape[1]))
        found = torch.cat([read(self.take(piece)) for piece in pieces])

        slots = sequences.get(_TEAM_ROW) * rounds.shape[-1] + sequences.get(MEMBER)
        flat = found.new_zeros(len(rounds), view.valued.shape[1], found.shape[-1])
        flat[at[valid], slots.unsqueeze(-1).expand_as(at)[valid]] = found[valid]
        rounds.set(key, flat.view(*rounds.shape, -1))

    def take(self, minibatch: TensorDictBase) -> TensorDictBase:
        """Return what the loss reads of these sequences: entries ``[B, L, ...]``, states ``[B, M]``.

        With ``ppo.shuffle_members`` the critic's inputs have the members in an order of the minibatch's own.
        """
        own = [key for key in (*self._keys, *_LEARNT) if key in self._rounds]
        out = {key: self._own(key, minibatch) for key in own}
        valid = minibatch.get(_VALID).unsqueeze(-1)
        for key in (ACTOR_LEARNS, CRITIC_LEARNS):
            out[key] = out[key] & valid

        begin, team, member = minibatch.get(_ROUND)[:, 0], minibatch.get(_TEAM_ROW), minibatch.get(MEMBER)
        for key in (keys.MEMORY, *self._critic.state_names):
            out[key] = self._rounds[key][begin, team, member]

        seen = self._critic_keys + [keys.ACTION] * self._critic.has_baseline
        of_critic = {key: self._team(key, minibatch) if self._critic.sees_team else out[key] for key in seen}
        if self._shuffles and self._critic.sees_team:
            order = random_order(of_critic[seen[0]], dim=2)
            of_critic = {key: entry[:, :, order] for key, entry in of_critic.items()}
            member = order.argsort()[member]
        out |= {TEAM: TensorDict(of_critic, minibatch.batch_size), MEMBER: member}
        return TensorDict(out, minibatch.batch_size)

    def _own(self, key: str, at: TensorDictBase) -> Tensor:
        team, member = at.get(_TEAM_ROW).unsqueeze(-1), at.get(MEMBER).unsqueeze(-1)
        return self._rounds[key][at.get(_ROUND), team, member]

    def _team(self, key: str, at: TensorDictBase) -> Tensor:
        return self._rounds[key][at.get(_ROUND), at.get(_TEAM_ROW).unsqueeze(-1)]


def random_order(entry: Tensor, dim: int) -> Tensor:
    """Return a random order of a team's members, int64 ``[A]``, which an entry has in this dimension."""
    return torch.randperm(entry.shape[dim]).to(entry.device)


def make_rows(row_keys: list[str], critic: TensorDictModule, cfg: PPOConfig) -> TeamRows | SequenceRows:
    """Return what an update learns on: sequences where the critic (and so the actor) is recurrent."""
    if not isinstance(critic.module, RecurrentCritic):
        return TeamRows(row_keys, cfg.shuffle_members)
    return SequenceRows(row_keys, [str(key) for key in critic.in_keys], critic.module, cfg)
