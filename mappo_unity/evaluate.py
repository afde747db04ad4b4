"""Play episodes with fixed policies and sum up what they earn.

In: a BaseEnv and a policy for each behavior. Out: finished episodes, and figures as a dict. Prints
nothing, learns nothing.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import torch
from mlagents_envs.base_env import BaseEnv

from mappo_unity import checkpoint
from mappo_unity.backend import make_env_function
from mappo_unity.compose import load_config
from mappo_unity.policies import CheckpointPolicy, Policy
from mappo_unity.rounds import Episode
from mappo_unity.runs import CONFIG, find_run

MAX_ENV_STEPS = 5_000_000


def evaluate(run: Path, episodes: int, deterministic: bool = False, seed: int = 0) -> dict[str, Any]:
    """Play a run's policy in its own environment.

    Args:
        run: run folder (its best checkpoint plays, else its newest) or a checkpoint file.
        episodes: agent episodes of every behavior.

    Returns:
        Figures for the table and the JSON line of mappo-eval.

    Raises:
        ConfigError: no checkpoint, or one that does not fit the environment.
    """
    torch.set_num_threads(1)
    torch.manual_seed(seed)
    path = choose_checkpoint(run)
    policy = CheckpointPolicy(path, deterministic)
    cfg = load_config(find_run(run, "run") / CONFIG)
    env = make_env_function(cfg.env)(seed)
    try:
        finished = play(env, policy, episodes)
    finally:
        env.close()
    behaviors = {name: summarize(rows) for name, rows in finished.items()}
    return {
        "checkpoint": str(path),
        "agent_steps": policy.agent_steps,
        "deterministic": deterministic,
        "seed": seed,
    } | (next(iter(behaviors.values())) if len(behaviors) == 1 else {"behaviors": behaviors})


def choose_checkpoint(run: Path) -> Path:
    """Return a checkpoint file as it is; of a run folder the best, else the newest good one."""
    best = run / checkpoint.FOLDER / checkpoint.BEST
    if run.is_dir() and best.is_file():
        return best
    return checkpoint.newest_good(run)[0]


def play(env: BaseEnv, policy: Policy | dict[str, Policy], episodes: int) -> dict[str, list[Episode]]:
    """Play until the first ``episodes`` episodes *begun* of every behavior have ended.

    Counting the first ones begun, not the first ones ended, gives long episodes their due weight.

    Returns:
        The episodes of every behavior, in the order of their ends.
    """
    running: dict[tuple[str, int], list[float]] = {}
    counts = _Counts(episodes)
    env.reset()
    for _ in range(MAX_ENV_STEPS):
        for name in env.behavior_specs:
            decision, terminal = env.get_steps(name)
            _end_episodes(name, terminal, running, counts)
            _go_on(name, decision, running, counts)
            if len(decision):
                actor = policy[name] if isinstance(policy, dict) else policy
                env.set_actions(name, actor.act(name, decision, env.behavior_specs[name]))
        if counts.complete(list(env.behavior_specs)):
            return counts.ended
        env.step()
    raise RuntimeError(f"{episodes} episodes did not end within {MAX_ENV_STEPS} environment steps")


class _Counts:
    """Which episodes count: the first ``wanted`` begun of each behavior."""

    def __init__(self, wanted: int) -> None:
        self.wanted = wanted
        self.begun: dict[str, int] = {}
        self.ended: dict[str, list[Episode]] = {}

    def begin(self, name: str) -> bool:
        self.begun[name] = self.begun.get(name, 0) + 1
        return self.begun[name] <= self.wanted

    def complete(self, names: list[str]) -> bool:
        return all(len(self.ended.get(name, [])) >= self.wanted for name in names)


def _end_episodes(name: str, terminal: Any, running: dict, counts: _Counts) -> None:
    for row, agent in enumerate(terminal.agent_id.tolist()):
        episode = running.pop((name, agent), None)
        if episode is None:
            continue
        counted, individual, group, length = episode
        individual, group = (
            individual + float(terminal.reward[row]),
            group + float(terminal.group_reward[row]),
        )
        if counted:
            ended = Episode(agent, individual, group, int(length), bool(terminal.interrupted[row]))
            counts.ended.setdefault(name, []).append(ended)


def _go_on(name: str, decision: Any, running: dict, counts: _Counts) -> None:
    for row, agent in enumerate(decision.agent_id.tolist()):
        episode = running.get((name, agent))
        if episode is None:
            episode = running[name, agent] = [float(counts.begin(name)), 0.0, 0.0, 0.0]
        episode[1] += float(decision.reward[row])
        episode[2] += float(decision.group_reward[row])
        episode[3] += 1


def summarize(episodes: list[Episode]) -> dict[str, Any]:
    """Return the figures of episodes: returns with standard errors, length, share interrupted."""
    individual, group = (
        np.array(x, float) for x in zip(*[(e.individual_return, e.group_return) for e in episodes])
    )
    returns = individual + group
    out = {
        "episodes": len(episodes),
        "mean_return": float(returns.mean()),
        "stderr": float(returns.std() / math.sqrt(len(returns))),
        "mean_decisions": float(np.mean([e.length for e in episodes])),
        "interrupted": float(np.mean([e.interrupted for e in episodes])),
    }
    if group.any():
        out |= {"mean_individual_return": float(individual.mean()), "mean_group_return": float(group.mean())}
    return out
