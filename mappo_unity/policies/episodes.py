"""Play episodes of a BaseEnv with fixed policies, and sum up what they earn."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from mlagents_envs.base_env import BaseEnv

from mappo_unity.envs.rounds import Episode
from mappo_unity.errors import EnvironmentFailure
from mappo_unity.policies.policy import Policy
from mappo_unity.scenes.contract.records import RecordCheck
from mappo_unity.scenes.contract.rules import (
    MAX_SILENT_STEPS,
    check_silence,
    check_specs,
    late_behavior,
)
from mappo_unity.scenes.contract.statistics import pop_statistics

MAX_ENV_STEPS = 5_000_000
NUM_BATCHES = 40  # of consecutive episodes, at most
MIN_BATCH = 10  # episodes


class Ended(NamedTuple):
    """An episode that has ended, whether it counts or not."""

    episode: Episode
    began_at: int  # environment steps since the reset
    ended_at: int
    is_late: bool = False  # whether a reward came with its first decision: earned before it began


def play(
    env: BaseEnv,
    policy: Policy | dict[str, Policy],
    episodes: int,
    only: str | None = None,
    skip_first: bool = False,
    told: Callable[[str, Ended], None] = lambda name, ended: None,
) -> dict[str, list[Episode]]:
    """Play until the first ``episodes`` episodes *begun* of every behavior (or of ``only``) have ended.

    Counting the first ones begun, not the first ones ended, gives long episodes their due weight.

    Args:
        env: what is played in; it is reset first.
        policy: who plays, everybody or by behavior.
        episodes: how many count.
        only: the behavior that they are counted of; None: every one.
        skip_first: whether those that begin with the reset do not count. An environment that has been played
            in may go on from where its areas stand: Unity's own reset of the academy moves no ball.
        told: takes every episode that ends, also those that do not count, and its behavior.

    Returns:
        The episodes of every behavior, in the order of their ends.

    Raises:
        EnvironmentDataError: the environment breaks its contract, or nobody requests decisions any more.
        EnvironmentFailure: so many episodes do not end.
    """
    running: dict[tuple[str, int], list[float]] = {}
    counts = _Counts(episodes, skip_first, told)
    checks: dict[str, RecordCheck] = {}
    silent = 0  # steps in a row in which nobody requested a decision

    env.reset()
    check_specs(env.behavior_specs)
    for step in range(MAX_ENV_STEPS):
        counts.step = step
        silent = 0 if _act(env, policy, checks, running, counts) else silent + 1

        names = [only] if only else list(env.behavior_specs)
        # in a game of turns a side may be asked later
        counts.skips = counts.skips and not {*names} <= {name for name, _ in running}
        if names and counts.complete(names):
            return counts.ended
        check_silence(silent, MAX_SILENT_STEPS)
        env.step()
        pop_statistics(env)  # which nobody reads here: a player's would pile up

    raise _endless(env, episodes, counts)


def _act(
    env: BaseEnv,
    policy: Policy | dict[str, Policy],
    checks: dict[str, RecordCheck],
    running: dict[tuple[str, int], list[float]],
    counts: _Counts,
) -> bool:
    """Take in what the environment reports, and act; return whether anybody requested a decision."""
    asked = False
    for name in env.behavior_specs:
        if name not in checks:
            checks[name] = RecordCheck(name, env.behavior_specs[name])
        decision, terminal = checks[name](env.get_steps(name))
        _forget_crashed(env, name, running, counts)
        _end_episodes(name, terminal, running, counts)

        actor = _actor(policy, name)
        _tell(actor, name, decision, terminal, running)
        _go_on(name, decision, running, counts)
        if len(decision):
            asked = True
            env.set_actions(name, actor.act(name, decision, env.behavior_specs[name]))
    return asked


def _actor(policy: Policy | dict[str, Policy], behavior: str) -> Policy:
    if not isinstance(policy, dict):
        return policy
    if behavior not in policy:
        raise late_behavior(behavior, policy, "neither side plays it")
    return policy[behavior]


def _endless(env: BaseEnv, episodes: int, counts: _Counts) -> EnvironmentFailure:
    ended = {name: len(counts.ended.get(name, [])) for name in env.behavior_specs}
    return EnvironmentFailure(
        f"episodes={episodes}: so many did not end within {MAX_ENV_STEPS:,} environment steps, only {ended}; "
        "does anything end an agent's episode (EndEpisode, a time limit)?"
    )


class _Counts:
    """Which episodes count: the first ``wanted`` begun of each behavior; none while it ``skips``.

    Attributes: `step`, of the environment since its reset; `told`, of every episode that ends.
    """

    def __init__(self, wanted: int, skips: bool, told: Callable[[str, Ended], None]) -> None:
        self.wanted, self.skips = wanted, skips
        self.step, self.told = 0, told
        self.begun: dict[str, int] = {}  # of those that count
        self.ended: dict[str, list[Episode]] = {}

    def begin(self, name: str) -> bool:
        if self.skips or self.begun.get(name, 0) >= self.wanted:
            return False
        self.begun[name] = self.begun.get(name, 0) + 1
        return True

    def complete(self, names: list[str]) -> bool:
        return all(len(self.ended.get(name, [])) >= self.wanted for name in names)


def _forget_crashed(env: BaseEnv, name: str, running: dict, counts: _Counts) -> None:
    """Forget the episodes of agents whose player crashed (`RestartingPlayer`); others are begun instead."""
    for agent in getattr(env, "crashed_agents", {}).get(name, ()):
        episode = running.pop((name, int(agent)), None)
        if episode is not None and episode[0]:
            counts.begun[name] -= 1


def _tell(policy: Policy, name: str, decision: Any, terminal: Any, running: dict) -> None:
    """Tell a policy whose episodes have ended, and who begins one: its memory is of another episode."""
    policy.end(name, terminal.agent_id.tolist())
    policy.forget(name, [a for a in decision.agent_id.tolist() if (name, a) not in running])


def _end_episodes(name: str, terminal: Any, running: dict, counts: _Counts) -> None:
    for row, agent in enumerate(terminal.agent_id.tolist()):
        episode = running.pop((name, agent), None)
        if episode is None:
            continue

        # The last reward comes with the end, and belongs to the episode.
        counted, individual, group, length, group_id, began_at, is_late = episode
        individual, group = (
            individual + float(terminal.reward[row]),
            group + float(terminal.group_reward[row]),
        )

        cut = bool(terminal.interrupted[row])
        # the group of its decisions: Unity's UnregisterAgent takes it out of that before it ends
        ended = Episode(agent, individual, group, int(length), cut, int(group_id))
        if counted:
            counts.ended.setdefault(name, []).append(ended)
        counts.told(name, Ended(ended, int(began_at), counts.step, bool(is_late)))


def _go_on(name: str, decision: Any, running: dict, counts: _Counts) -> None:
    for row, agent in enumerate(decision.agent_id.tolist()):
        episode = running.get((name, agent))
        if episode is None:
            is_late = float(decision.reward[row] != 0 or decision.group_reward[row] != 0)
            begun = [float(counts.begin(name)), 0.0, 0.0, 0.0, 0.0, float(counts.step), is_late]
            episode = running[name, agent] = begun

        episode[1] += float(decision.reward[row])
        episode[2] += float(decision.group_reward[row])
        episode[3] += 1
        episode[4] = float(decision.group_id[row])


def summarize(episodes: list[Episode]) -> dict[str, Any]:
    """Return the figures of episodes: returns with standard errors, length, share interrupted."""
    individual, group = (
        np.array(x, float) for x in zip(*[(e.individual_return, e.group_return) for e in episodes])
    )

    returns = individual + group
    out = {
        "episodes": len(episodes),
        "mean_return": float(returns.mean()),
        "stderr": standard_error(returns, any(e.group_id for e in episodes)),
        "mean_decisions": float(np.mean([e.length for e in episodes])),
        "interrupted": float(np.mean([e.interrupted for e in episodes])),
    }

    if group.any():
        out |= {"mean_individual_return": float(individual.mean()), "mean_group_return": float(group.mean())}

    return out


def standard_error(values: np.ndarray, teams: bool = False) -> float:
    """Return the standard error of the mean of episodes' returns, in the order of their ends; NaN of one.

    Team mates earn the same and end together, so for teams it is taken from the means of consecutive
    batches (batch means; Law and Kelton, Simulation Modeling and Analysis) as long as there are some.
    """
    if teams and len(values) >= 2 * MIN_BATCH:
        batches = np.array_split(values, min(NUM_BATCHES, len(values) // MIN_BATCH))
        values = np.array([batch.mean() for batch in batches])

    return float(values.std(ddof=1) / math.sqrt(len(values))) if len(values) > 1 else math.nan
