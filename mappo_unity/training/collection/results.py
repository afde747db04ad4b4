"""How opponents fared in a batch: the episodes of the teams that they played, apart from the learner's."""

from __future__ import annotations

from typing import NamedTuple

import torch
from tensordict import TensorDictBase

from mappo_unity import keys
from mappo_unity.envs.rounds import Episode
from mappo_unity.envs.unity_env import UnityEnv
from mappo_unity.learning.networks.opponents import Opponents


class Result(NamedTuple):
    """How an agent that an opponent played fared against those who learn."""

    behavior: str
    opponent: int  # its number
    score: float  # 1 won, 0.5 drawn, 0 lost


def split_episodes(
    episodes: dict[str, list[Episode]], rounds: TensorDictBase, env: UnityEnv
) -> tuple[dict[str, list[Episode]], list[Result]]:
    """Return the learner's episodes, and the results of the others.

    As in ML-Agents a result is the sign of the last reward, an agent's own and its group's, of an episode
    that ends uninterrupted, and with all of its team.

    Args:
        episodes: those that finished in the batch, for each behavior.
        rounds: the batch ``[T]``, whose last row is the environment's last round.
        env: what was played.
    """
    own: dict[str, list[Episode]] = {}
    results: list[Result] = []
    for behavior, finished in episodes.items():
        name = keys.policy_name(behavior)
        sides = env.sides[name]
        whole = [rounds.get((name, keys.PLAYER)), rounds.get(("next", name, keys.DONE))]
        whole += [rounds.get(("next", name, key)) for key in (keys.REWARD, keys.GROUP_REWARD)]
        if len(sides) > 1:
            whole = [entry[:, sides.index(behavior)] for entry in whole]
        # [T, N], N slots of the behavior
        players, done, reward, group_reward = (entry.flatten(1) for entry in whole)

        own[behavior] = []
        first = env.rounds - len(players)
        for episode in finished:
            at = episode.round - first, episode.slot
            opponent = int(players[at])
            if opponent == keys.LEARNER:
                own[behavior].append(episode)
            elif bool(done[at]) and not episode.interrupted:
                last = float(reward[at] + group_reward[at])
                results.append(Result(behavior, opponent, (1 + (last > 0) - (last < 0)) / 2))
    return own, results


def count_learning(env: UnityEnv, opponents: Opponents) -> tuple[int, int]:
    """Return how many agents are there now that learners play, and how many slots these can have."""
    count = slots = 0
    for name, sides in env.sides.items():
        present = torch.stack([torch.from_numpy(env.behaviors[side].present) for side in sides])
        players = opponents.playing.get(name)
        if players is not None:
            learns = (players == keys.LEARNER).cpu().reshape(len(sides), -1, 1)
            present = present.reshape(*learns.shape[:2], -1)
            slots += int(learns.expand_as(present).sum())
            present = present & learns
        else:
            slots += present.numel()
        count += int(present.sum())
    return count, slots
