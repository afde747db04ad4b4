"""The loop of scripts that watch a policy play in a scene that notes what happens."""

from __future__ import annotations

from collections.abc import Callable

from mlagents_envs.base_env import BaseEnv

from mappo_unity.policies.policy import Policy


def play_until(is_enough: Callable[[], bool], env: BaseEnv, policy: Policy) -> None:
    """Reset `env`, then let `policy` play for all behaviors until `is_enough`, asked before every step."""
    env.reset()
    while not is_enough():
        for name, spec in env.behavior_specs.items():
            decisions, _ = env.get_steps(name)
            if len(decisions):
                env.set_actions(name, policy.act(name, decisions, spec))
        env.step()
