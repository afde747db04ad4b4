"""Lineups: who plays which team, from the driver that decides it to the workers that play."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor, nn

from mappo_unity.keys import LEARNER
from mappo_unity.learning.networks.actor_critic import UnityActor
from mappo_unity.learning.networks.joint_policy import JointPolicy
from mappo_unity.learning.networks.opponents import Player
from mappo_unity.training.collection.description import Played

Network = dict[str, Tensor] | Player | None
"""What an opponent is made from: a past policy's tensors, a player, or None: the newest weights."""
Players = dict[str, Tensor]
"""Who plays each team from its next episode on, by policy name: int64 of each place, see `Opponents`."""


@dataclass(frozen=True)
class Lineup:
    """Who plays from now on.

    Attributes:
        players: of each worker.
        networks: by number and policy name, of the opponents that play, or will at a next episode. A worker
            keeps those that it has got.
        kept: numbers whose networks are worth keeping.
    """

    players: tuple[Players, ...]
    networks: dict[int, dict[str, Network]]
    kept: frozenset[int]


class Lineups:
    """The lineups of several workers: the one that is decided, and the one of the newest request."""

    def __init__(self) -> None:
        self._decided: Lineup | None = None  # and not sent yet
        self._sent: Lineup | None = None
        self._known: set[int] = set()  # numbers whose networks all workers have
        self._behind: tuple[Players, ...] | None = None  # of a request that a checkpoint was written beside

    def decide(self, lineup: Lineup) -> None:
        """Take the lineup of the next request."""
        self._decided = lineup

    def next(self, behind: bool) -> Lineup | None:
        """Return what workers are to be told before a request, with the networks that they do not have.

        Args:
            behind: whether the request is that which a checkpoint was written beside.
        """
        if self._decided is None:
            return None
        if behind and self._behind is not None:
            self._sent = replace(self._decided, players=self._behind)
        else:
            self._sent, self._decided = self._decided, None
        self._behind = None

        new = {n: network for n, network in self._sent.networks.items() if n not in self._known}
        self._known = (self._known | new.keys()) & self._sent.kept
        return replace(self._sent, networks=new)

    @property
    def sent(self) -> Lineup | None:
        """The lineup of the newest request, with all its networks, for a worker that is replaced."""
        return self._sent

    def forget(self) -> None:
        """Take note of a worker that begins anew, with the networks of `sent` and no others."""
        self._known &= self._sent.networks.keys() if self._sent is not None else set()

    @property
    def numbers(self) -> set[int]:
        """The numbers of all that play in the newest request, or in the one behind."""
        players = self._behind or (self._sent.players if self._sent is not None else ())
        return numbers_in(part for own in players for part in own.values())

    def state_dict(self) -> list[Players] | None:
        """Return who plays in the newest request."""
        return None if self._sent is None else list(self._sent.players)

    def load_state_dict(self, state: Sequence[Players] | None) -> None:
        """Let the next request be played by those whom `state_dict` returned."""
        self._behind = None if state is None else tuple(state)


def numbers_in(players: Iterable[Tensor]) -> set[int]:
    """Return the numbers of opponents among those who play."""
    return {number for part in players for number in part.unique().tolist()} - {LEARNER}


def count_pairs(part: Played) -> int:
    """Return how many pairs of teams a worker has; of a side with fewer teams the last ones have none."""
    return max(behavior.slots.num_teams for behavior in part.behaviors.values())


def players_of_pairs(drawn: Mapping[str, np.ndarray], parts: Sequence[Played]) -> Players:
    """Return who plays the teams of all workers, which stand side by side.

    Args:
        drawn: who plays in each pair, int64 ``[pairs]`` by behavior, one worker's behind another's.
        parts: what each worker has.
    """
    pairs = [count_pairs(part) for part in parts]
    players: Players = {}
    for name, sides in parts[0].sides.items():
        joint = torch.from_numpy(np.stack([drawn[side] for side in sides])).split(pairs, -1)
        own = torch.cat([share[:, : _teams(part, name)] for share, part in zip(joint, parts)], -1)
        players[name] = own if len(sides) > 1 else own[0]
    return players


def split_players(players: Players, parts: Sequence[Played]) -> tuple[Players, ...]:
    """Return each worker's part of what `players_of_pairs` returns."""
    shares = {
        name: joint.cpu().split([_teams(part, name) for part in parts], -1) for name, joint in players.items()
    }
    return tuple(
        {name: share[number].clone() for name, share in shares.items()} for number in range(len(parts))
    )


def fits_teams(players: Players, parts: Sequence[Played]) -> bool:
    """Return whether players are of as many teams as all workers have."""
    return all(
        joint.shape[-1] == sum(_teams(part, name) for part in parts) for name, joint in players.items()
    )


def _teams(part: Played, name: str) -> int:
    return part.behaviors[part.sides[name][0]].slots.num_teams


def line_up(
    policy: JointPolicy, players: Players, networks: Mapping[int, Mapping[str, Network]], device: str
) -> None:
    """Let opponents play teams from their next episodes on.

    Args:
        policy: with opponents.
        players: who plays.
        networks: by number and policy name, of those whom the policy does not have yet.
        device: of the policy.
    """
    opponents = policy.opponents
    assert opponents is not None, "a policy that plays alone"
    for name, actor in zip(policy.names, policy.actors.values()):
        opponents.plan(name, players[name].to(device))
        opponents.retire(name)

        assert isinstance(actor, UnityActor)
        known = opponents.actors.setdefault(name, {})
        # a run that is resumed may have to do without some
        opponents.replace(name, known.keys() | {number for number, own in networks.items() if name in own})
        for number in opponents.used(name) - known.keys():
            known[number] = make_player(actor, networks[number][name])


def make_player(learner: UnityActor, network: Network) -> Player:
    """Return who plays for an opponent.

    Args:
        learner: in whose place it plays.
        network: what it is made from.
    """
    if network is None:
        return learner
    if not isinstance(network, dict):
        return network

    actor = copy.deepcopy(learner)
    actor.keeps_components = False
    actor.load_state_dict(network)
    for module in actor.modules():
        if isinstance(module, nn.RNNBase):
            # a copy's weights lie apart in memory, where cuDNN would gather them in every call
            module.flatten_parameters()
    return actor.eval()
