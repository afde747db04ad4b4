"""The environment of a run that learns from demonstrations alone: they themselves, played back."""

from __future__ import annotations

from mlagents_envs.base_env import BehaviorSpec

from mappo_unity import keys
from mappo_unity.config.per_behavior import behavior_config
from mappo_unity.config.schema import Backend, Config
from mappo_unity.envs.backends import MakeEnv, make_env_function
from mappo_unity.errors import ConfigError
from mappo_unity.protocol.demos.demonstration import Demonstration, check_matches
from mappo_unity.protocol.demos.reader import read_demos
from mappo_unity.protocol.demos.replay_env import ReplayEnv


def make_replay_function(cfg: Config) -> MakeEnv:
    """Return the function that plays back the demonstrations of every behavior that has some.

    Scenes and custom environments are asked for their behaviors, which must fit. Unity is not started: the
    demonstration says what the behavior is.

    Raises:
        ConfigError: a demonstration cannot be read, or does not fit.
    """
    specs = _specs(cfg)
    if specs is None:
        if not cfg.bc.demos:
            raise ConfigError(
                f"bc.only=true with env.backend={cfg.env.backend.value} needs bc.demos=[expert.demo]: the "
                "recording says what the behavior is"
            )
        demo = read_demos(cfg.bc.demos)
        return lambda seed: ReplayEnv({demo.behavior: demo})

    demos: dict[str, Demonstration] = {}
    for behavior, spec in specs.items():
        # both sides of a policy learn from the same recording, and have the same options
        name = keys.policy_name(behavior)
        paths = behavior_config(cfg, name).bc.demos
        if not paths:
            raise ConfigError(
                f"bc.only=true, but {name} has no demonstrations: behaviors.{name}.bc.demos=[expert.demo]"
            )
        demos[behavior] = read_fitting(paths, spec, name)
    return lambda seed: ReplayEnv(demos)


def read_fitting(paths: list[str], spec: BehaviorSpec, name: str) -> Demonstration:
    """Return demonstrations that fit a behavior; raise ConfigError for others."""
    demo = read_demos(paths)
    check_matches(demo, spec, name)
    if not demo.has_action.any():
        raise ConfigError(f"demonstration {demo.source} says of no decision what was done: nothing to learn")
    return demo


def _specs(cfg: Config) -> dict[str, BehaviorSpec] | None:
    if cfg.env.backend not in (Backend.embedded, Backend.custom, Backend.pettingzoo):
        return None
    env = make_env_function(cfg.env)(cfg.seed)
    try:
        env.reset()
        return dict(env.behavior_specs)
    finally:
        env.close()
