"""The builder: options and an environment to networks, learners and the sizes of a batch.

In: `Config`. Out: TorchRL objects. What an environment has (sensors, actions, teams) is read from it.
"""

from __future__ import annotations

import logging
from pathlib import Path

import torch

from mappo_unity.actions import CONTINUOUS_LIMIT, ActionLayout
from mappo_unity.backend import make_env_function
from mappo_unity.behavior_options import check_behaviors, options_of
from mappo_unity.collect import num_rounds
from mappo_unity.config import Config, ConfigError
from mappo_unity.encoders import ObsLayout
from mappo_unity.models import make_actor, make_critic
from mappo_unity.ppo import PolicyLearner
from mappo_unity.rng import seed_everything
from mappo_unity.runs import PLAYERS
from mappo_unity.unity_env import UnityEnv


def prepare_torch(cfg: Config) -> None:
    """Set threads and seeds; check the device."""
    torch.set_num_threads(cfg.num_threads)
    logging.getLogger("torchrl").setLevel(logging.WARNING)  # it announces every storage
    if cfg.device.startswith("cuda") and not torch.cuda.is_available():
        raise ConfigError(f"device={cfg.device}: this torch finds no CUDA device; use device=cpu")
    seed_everything(cfg.seed)


def make_unity_env(cfg: Config, folder: Path) -> UnityEnv:
    """Open the environment of the options behind the adapter; players log below the run's folder."""
    return UnityEnv(
        make_env_function(cfg.env, folder / PLAYERS),
        cfg.seed,
        action_limit=CONTINUOUS_LIMIT,
        max_team_size=cfg.env.max_team_size,
        max_teams=cfg.env.max_teams,
        death_masking=cfg.ppo.death_masking,
    )


def batch_rounds(cfg: Config, env: UnityEnv) -> int:
    """Return the rounds of a batch, for the agents that the environment began with."""
    return num_rounds(cfg.collect, sum(int(behavior.present.sum()) for behavior in env.behaviors.values()))


def make_learners(cfg: Config, env: UnityEnv) -> dict[str, PolicyLearner]:
    """Build networks and learner of every policy name."""
    check_behaviors(cfg, env.sides)
    learners, rounds = {}, batch_rounds(cfg, env)
    for name, sides in env.sides.items():
        model, ppo = options_of(cfg, name)
        behavior = env.behaviors[sides[0]]
        teams, team_size = behavior.slots.num_teams * len(sides), behavior.slots.team_size
        rows, agents = rounds * teams, teams * team_size
        wanted = ppo.minibatch_size if ppo.num_minibatches is None else ppo.num_minibatches * team_size
        if wanted > rows * team_size:
            option = "ppo.minibatch_size" if ppo.num_minibatches is None else "ppo.num_minibatches"
            raise ConfigError(
                f"{option}={getattr(ppo, option[4:])} is larger than the batch of {name!r}: "
                f"{rounds} rounds x {agents} agents = {rows * team_size} decisions; "
                f"lower {option}, or raise collect.batch_size (or collect.rounds, where it is given)"
            )
        obs = ObsLayout.from_specs(behavior.spec.observation_specs)
        layout = ActionLayout.from_spec(behavior.spec.action_spec, model.flatten_branches)
        actor = make_actor(obs, layout, team_size, model).to(cfg.device)
        critic = make_critic(obs, team_size, model).to(cfg.device)
        learners[name] = PolicyLearner(actor, critic, ppo, rows, team_size)
    return learners
