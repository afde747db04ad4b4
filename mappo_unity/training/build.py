"""The builder: options and an environment to networks, learners and the sizes of a batch.

In: `Config`. Out: TorchRL objects. What an environment has (sensors, actions, teams) is read from it.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path

import torch

from mappo_unity.config.per_behavior import check_behaviors, options_of
from mappo_unity.config.schema import Config, ConfigError, ModelConfig
from mappo_unity.envs.backends import make_env_function
from mappo_unity.envs.unity_env import UnityEnv
from mappo_unity.learning.actor_critic import make_actor, make_critic
from mappo_unity.learning.distributions import CONTINUOUS_LIMIT, ActionLayout
from mappo_unity.learning.encoders import ObsLayout
from mappo_unity.learning.ppo import PolicyLearner
from mappo_unity.runs.folder import PLAYERS
from mappo_unity.runs.rng import seed_everything
from mappo_unity.training.collect import num_rounds
from mappo_unity.training.memory import check_free, show_size

BATCH_COPIES = 6
"""Memory of a batch in units of its observations: as they were and as next ones, as rounds and as a stack of
them, and the rows that are learnt with what the networks make of them."""
WEIGHT_COPIES = 10
"""Memory of learning in units of the weights: gradients, two moments of Adam, and two copies of weights and
moments, to roll an update back and to save the last complete iteration."""


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


def make_learners(cfg: Config, env: UnityEnv, note: Callable[[str], None]) -> dict[str, PolicyLearner]:
    """Build networks and learner of every policy name.

    Args:
        cfg: the run's options.
        env: what is played.
        note: takes a line for the user about an option that does not fit and follows another.

    Raises:
        ConfigError: options do not fit the environment, or what they ask for does not fit into memory.
    """
    check_behaviors(cfg, env.sides)
    check_memory(cfg, env)
    learners, rounds = {}, batch_rounds(cfg, env)
    for name, sides in env.sides.items():
        model, ppo = options_of(cfg, name)
        behavior = env.behaviors[sides[0]]
        teams, team_size = behavior.slots.num_teams * len(sides), behavior.slots.team_size
        rows, agents = rounds * teams, teams * team_size
        if (ppo.num_minibatches or 0) > rows:
            raise ConfigError(
                f"ppo.num_minibatches={ppo.num_minibatches} is larger than the batch of {name!r}: {rounds} "
                f"rounds x {teams} teams = {rows} team rows; lower ppo.num_minibatches, or raise "
                "collect.batch_size (or collect.rounds, where it is given)"
            )
        if ppo.num_minibatches is None and ppo.minibatch_size > rows * team_size:
            note(
                f"note: ppo.minibatch_size={ppo.minibatch_size} is larger than the batch of {name}: {rounds} "
                f"rounds x {agents} agents = {rows * team_size} decisions, learnt as one minibatch"
            )
        obs = ObsLayout.from_specs(behavior.spec.observation_specs)
        layout = ActionLayout.from_spec(behavior.spec.action_spec, model.flatten_branches)
        check_networks(name, obs, layout, team_size, model)
        actor = make_actor(obs, layout, team_size, model).to(cfg.device)
        critic = make_critic(obs, team_size, model).to(cfg.device)
        learners[name] = PolicyLearner(actor, critic, ppo, rows, team_size)
    return learners


def check_memory(cfg: Config, env: UnityEnv) -> None:
    """Raise ConfigError if a batch does not fit into the memory that is free."""
    rounds = batch_rounds(cfg, env)
    if cfg.collect.rounds is None:
        option, size = "collect.batch_size", cfg.collect.batch_size
    else:
        option, size = "collect.rounds", cfg.collect.rounds
    one_round = env.root().bytes()
    check_free(
        BATCH_COPIES * one_round * rounds,
        f"{option}={size}: learning from a batch of {rounds:,} rounds of {show_size(one_round)}",
        f"lower {option}, or env.num_areas where the environment has it",
    )


def check_networks(name: str, obs: ObsLayout, layout: ActionLayout, team_size: int, cfg: ModelConfig) -> None:
    """Raise ConfigError if a policy's networks do not fit into the memory that is free."""
    with torch.device("meta"), torch.random.fork_rng(devices=[]):  # shapes without numbers
        nets = make_actor(obs, layout, team_size, cfg), make_critic(obs, team_size, cfg)
    size = sum(p.numel() * p.element_size() for net in nets for p in net.parameters())
    check_free(
        WEIGHT_COPIES * size,
        f"model.hidden={list(cfg.hidden)}, critic {list(cfg.critic_hidden or cfg.hidden)}: learning the "
        f"networks of {name} ({show_size(size)})",
        "lower model.hidden or model.critic_hidden",
    )
