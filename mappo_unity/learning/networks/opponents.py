"""Opponents: frozen policies that play some of the teams while the policy that learns plays the others.

Who plays a team changes only where its episode begins, so that a match is played to its end against the same
opponent. What opponents do is not learnt from: their agents do not act in the learner's sense.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from mappo_unity import keys
from mappo_unity.keys import LEARNER
from mappo_unity.learning.networks.actor_critic import UnityActor
from mappo_unity.learning.networks.distributions import ActionLayout


class Opponents:
    """Frozen policies, and which team each of them plays.

    A team's place is that of its policy name's entries without their last dimension: ``[G]``, or ``[S, G]``
    where several sides share the name.

    Attributes: `actors`, by policy name and number; `playing`, int64 of each place, by policy name: a number,
    or `keys.LEARNER`; `following`, likewise, who plays a team from its next episode on.
    """

    def __init__(self) -> None:
        self.actors: dict[str, dict[int, Player]] = {}
        self.playing: dict[str, Tensor] = {}
        self.following: dict[str, Tensor] = {}
        self._memories: dict[str, dict[int, Tensor]] = {}  # states [..., A, M] before an opponent's decisions
        self._places: dict[str, list[tuple[int, Tensor]]] = {}  # flat places of each number that plays

    def plan(self, name: str, players: Tensor) -> None:
        """Say who plays each team of a policy name from the team's next episode on, int64 of each place."""
        self.following[name] = players

    def used(self, name: str) -> set[int]:
        """Return the numbers of the opponents of a policy name that play, or will at a next episode."""
        known = [players[name] for players in (self.playing, self.following) if name in players]
        return {number for players in known for number in players.unique().tolist()} - {LEARNER}

    def replace(self, name: str, known: set[int]) -> None:
        """Let the learner play the teams of opponents of a policy name that are not among the known ones."""
        numbers = torch.tensor(sorted(known | {LEARNER}))
        for players in (self.playing, self.following):
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
        if name in self.following and bool(begins.any()):
            self.playing[name] = torch.where(begins, self.following[name], self.playing[name])
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
        rows = action.view(-1, *action.shape[-2:])
        drawn: dict[ActionLayout, list[tuple[Tensor, Tensor, UnityActor]]] = {}
        for number, places in self._places[name]:
            actor = self.actors[name][number]
            if isinstance(actor, RandomActor):
                rows[places] = actor.choose(_rows(entries, actor.in_keys, places)).to(rows.dtype)
            else:
                params = self._params(name, number, actor, entries, places, asked)
                drawn.setdefault(actor.layout, []).append((places, params, actor))

        # what is drawn alike is drawn at once: on small networks that costs more than the network
        for parts in drawn.values():
            places, params = (torch.cat(column) for column in zip(*[part[:2] for part in parts]))
            actor = parts[0][2]
            masks = _rows(entries, [keys.MASK] if actor.layout.branches else [], places)
            rows[places] = actor.distribution(params, masks).sample().to(rows.dtype)
        entries.set(keys.ACTION, action)

    def _params(
        self,
        name: str,
        number: int,
        actor: UnityActor,
        entries: TensorDictBase,
        places: Tensor,
        asked: Tensor,
    ) -> Tensor:
        """Return the parameters ``[n, A, P]`` of an actor's actions in flat places; keep its memory."""
        seen = _rows(entries, actor.in_keys, places)
        if not actor.has_memory:
            return actor.params(seen)[0]

        known = self._memories.setdefault(name, {})
        if number not in known:
            known[number] = torch.zeros(*asked.shape[:-1], actor.memory_size, device=asked.device)
        memory = known[number].view(-1, asked.shape[-2], actor.memory_size)

        first = _rows(entries, [keys.FIRST], places).get(keys.FIRST)
        before = torch.where(first, 0.0, memory[places])
        params, after = actor.params(seen.set(keys.MEMORY, before))
        assert after is not None
        # frozen while an agent is not asked
        acting = asked.reshape(-1, *asked.shape[-2:])[places]
        memory[places] = torch.where(acting, after, before)
        return params

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
        return {"playing": dict(self.playing), "following": dict(self.following), "memories": memories}

    def load_state_dict(self, state: Mapping[str, Any], device: str) -> None:
        """Restore what `state_dict` returned."""
        self._places = {}
        self.playing = {name: players.to(device) for name, players in state["playing"].items()}
        self.following = {name: players.to(device) for name, players in state["following"].items()}
        self._memories = {
            name: {int(number): memory.to(device) for number, memory in known.items()}
            for name, known in state["memories"].items()
        }


def _rows(entries: TensorDictBase, wanted: Iterable[Any], places: Tensor) -> TensorDict:
    """Return entries of teams ``[n, A]`` in flat places, but for memories."""
    read = [str(key) for key in wanted if key != keys.MEMORY]
    own = {key: entries.get(key).flatten(0, entries.batch_dims - 2)[places] for key in read}
    return TensorDict(own, [len(places), entries.shape[-1]])


class RandomActor:
    """Uniform actions: continuous ones within +-`limit`, one of the allowed branches for discrete ones.

    Args:
        actor: whose place it takes; its actions have the same layout.
        limit: of continuous actions, as the environment's adapter takes them.
        device: of the actions.
    """

    def __init__(self, actor: UnityActor, limit: float, device: str) -> None:
        self._layout, self._limit, self._device = actor.layout, limit, device
        self.in_keys = [keys.MASK] if actor.layout.branches else []

    def choose(self, entries: TensorDictBase) -> Tensor:
        """Return actions for entries ``[..., A]``."""
        shape, device = entries.batch_size, self._device
        size, branches = self._layout.continuous, self._layout.branches

        parts = [(torch.rand(*shape, size, device=device) * 2 - 1) * self._limit] if size else []
        if branches:
            # what is forbidden scores below every draw
            scores = torch.rand(*shape, sum(branches), device=device) - (~entries.get(keys.MASK)).float()
            parts += [part.argmax(-1, keepdim=True).float() for part in scores.split(list(branches), -1)]
        return torch.cat(parts, -1)


Player = UnityActor | RandomActor
"""What plays for an opponent."""
