"""Opponents: frozen policies that play some of the teams while the policy that learns plays the others.

Who plays a team changes only where its episode begins, so that a match is played to its end against the same
opponent. What opponents do is not learnt from: their agents do not act in the learner's sense.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import torch
from tensordict import TensorDictBase
from torch import Tensor

from mappo_unity import keys
from mappo_unity.keys import LEARNER
from mappo_unity.learning.networks.actor_critic import Draw, UnityActor


class Draws(Protocol):
    """What plays for an opponent: an actor, or chance."""

    memory_size: int

    def draw(self, entries: TensorDictBase, deterministic: bool = False) -> Draw:
        """Return actions for entries ``[n, A]``."""
        ...


class Opponents:
    """Frozen policies, and which team each of them plays.

    A team's place is that of its policy name's entries without their last dimension: ``[G]``, or ``[S, G]``
    where several sides share the name.

    Attributes: `actors`, by policy name and number; `playing`, int64 of each place, by policy name: a number,
    or `keys.LEARNER`.
    """

    def __init__(self) -> None:
        self.actors: dict[str, dict[int, Draws]] = {}
        self.playing: dict[str, Tensor] = {}
        self._following: dict[str, Tensor] = {}  # likewise, who plays a team from its next episode on
        self._memories: dict[str, dict[int, Tensor]] = {}  # states [..., A, M] before an opponent's decisions
        self._places: dict[str, list[tuple[int, Tensor]]] = {}  # flat places of each number that plays

    def plan(self, name: str, players: Tensor) -> None:
        """Say who plays each team of a policy name from the team's next episode on, int64 of each place."""
        self._following[name] = players

    def used(self, name: str) -> set[int]:
        """Return the numbers of the opponents of a policy name that play, or will at a next episode."""
        known = [players[name] for players in (self.playing, self._following) if name in players]
        return {number for players in known for number in players.unique().tolist()} - {LEARNER}

    def replace(self, name: str, known: set[int]) -> None:
        """Let the learner play the teams of opponents of a policy name that are not among the known ones."""
        numbers = torch.tensor(sorted(known | {LEARNER}))
        for players in (self.playing, self._following):
            if name in players:
                is_known = torch.isin(players[name], numbers.to(players[name].device))
                players[name] = torch.where(is_known, players[name], LEARNER)
        self._places.pop(name, None)

    def retire(self, name: str) -> None:
        """Forget the opponents of a policy name that play no team any more."""
        used = self.used(name)
        for known in (self.actors.get(name, {}), self._memories.get(name, {})):
            for number in known.keys() - used:
                del known[number]

    def take_places(self, name: str, entries: TensorDictBase) -> Tensor:
        """Let opponents take their places, before anybody acts; return who requested a decision.

        Writes `keys.PLAYER`; `keys.ACTING` stays true of the learner's agents alone.

        Args:
            entries: ``[..., A]`` of a policy name, as the environment handed them out.

        Returns:
            bool ``[..., A, 1]``, `keys.ACTING` as it was.
        """
        acting, first = entries.get(keys.ACTING), entries.get(keys.FIRST)
        if name not in self.playing:
            self.playing[name] = torch.full(acting.shape[:-2], LEARNER, device=acting.device)

        begins = (first.any(-2) & ~(acting & ~first).any(-2)).squeeze(-1)
        if name in self._following and bool(begins.any()):
            self.playing[name] = torch.where(begins, self._following[name], self.playing[name])
            self._places.pop(name, None)

        players = self.playing[name][..., None, None].expand(acting.shape)
        entries.set(keys.PLAYER, players)
        entries.set(keys.ACTING, acting & (players == LEARNER))
        return acting

    def act(self, name: str, entries: TensorDictBase, asked: Tensor) -> None:
        """Write the opponents' actions over those that the learner drew in their places.

        Args:
            entries: ``[..., A]``, with actions.
            asked: what `take_places` returned.
        """
        if name not in self._places:
            self._places[name] = self._find_places(name)
        if not self._places[name]:
            return

        action = entries.get(keys.ACTION).clone()
        shape, flat = action.shape, entries.exclude(keys.ACTION, keys.LOG_PROB, keys.LOG_PROBS, keys.MEMORY)
        flat, rows = flat.reshape(-1, shape[-2]), action.view(-1, *shape[-2:])
        for number, places in self._places[name]:
            rows[places] = self._draw(name, number, flat[places], places, asked).to(rows.dtype)
        entries.set(keys.ACTION, action)

    def _draw(self, name: str, number: int, entries: TensorDictBase, places: Tensor, asked: Tensor) -> Tensor:
        """Return the actions ``[n, A, *]`` of an opponent in the places ``[n]`` that it plays."""
        actor = self.actors[name][number]
        if not actor.memory_size:
            return actor.draw(entries).action

        known = self._memories.setdefault(name, {})
        if number not in known:
            known[number] = torch.zeros(*asked.shape[:-1], actor.memory_size, device=asked.device)
        memory = known[number].view(-1, asked.shape[-2], actor.memory_size)

        before = torch.where(entries.get(keys.FIRST), 0.0, memory[places])
        drawn = actor.draw(entries.set(keys.MEMORY, before))
        # frozen while an agent is not asked
        acting = asked.reshape(-1, asked.shape[-2], 1)[places]
        memory[places] = before if drawn.memory is None else torch.where(acting, drawn.memory, before)
        return drawn.action

    def _find_places(self, name: str) -> list[tuple[int, Tensor]]:
        flat = self.playing[name].flatten()
        numbers = [number for number in flat.unique().tolist() if number != LEARNER]
        return [(number, (flat == number).nonzero().squeeze(-1)) for number in numbers]

    def state_dict(self) -> dict[str, Any]:
        """Return what resuming needs beside the actors."""
        memories = {
            name: {str(number): memory.clone() for number, memory in known.items()}
            for name, known in self._memories.items()
        }
        return {"playing": dict(self.playing), "following": dict(self._following), "memories": memories}

    def load_state_dict(self, state: Mapping[str, Any], device: str) -> None:
        """Restore what `state_dict` returned."""
        self._places = {}
        self.playing = {name: players.to(device) for name, players in state["playing"].items()}
        self._following = {name: players.to(device) for name, players in state["following"].items()}
        self._memories = {
            name: {int(number): memory.to(device) for number, memory in known.items()}
            for name, known in state["memories"].items()
        }


class RandomActor:
    """Uniform actions: continuous ones within +-`limit`, one of the allowed branches for discrete ones.

    Args:
        actor: whose place it takes; its actions have the same layout.
        limit: of continuous actions, as the environment's adapter takes them.
    """

    memory_size = 0

    def __init__(self, actor: UnityActor, limit: float) -> None:
        self._layout, self._limit, self._obs_key = actor.layout, limit, actor.obs_keys[0]

    def draw(self, entries: TensorDictBase, deterministic: bool = False) -> Draw:
        """Return actions for entries ``[..., A]``."""
        shape, device = entries.batch_size, entries.get(self._obs_key).device
        size, branches = self._layout.continuous, self._layout.branches

        parts = [(torch.rand(*shape, size, device=device) * 2 - 1) * self._limit] if size else []
        if branches:
            # what is forbidden scores below every draw
            scores = torch.rand(*shape, sum(branches), device=device) - (~entries.get(keys.MASK)).float()
            parts += [part.argmax(-1, keepdim=True).float() for part in scores.split(list(branches), -1)]
        return Draw(torch.cat(parts, -1), torch.zeros(shape, device=device), None, None)
