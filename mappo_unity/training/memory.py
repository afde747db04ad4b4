"""How much memory is free, and whether a batch and the networks fit into it."""

from __future__ import annotations

import os
from pathlib import Path

import torch
from torch import nn

from mappo_unity.config.schema import Config, ModelConfig, RewardsConfig
from mappo_unity.errors import ConfigError
from mappo_unity.learning.networks.actor_critic import make_actor, make_critic
from mappo_unity.learning.networks.distributions import ActionLayout
from mappo_unity.learning.networks.encoders import ObsLayout
from mappo_unity.learning.rewards.streams import make_models
from mappo_unity.training.collection.description import Played, describe

BATCH_COPIES = 4
"""Memory of a batch in units of its observations: as collected, behind the rounds that are carried, the rows
that are learnt, and what the networks make of them."""
SHARED_COPIES = 2
"""Further copies with workers in processes: two sets of shared memory."""
WEIGHT_COPIES = 10
"""Memory of learning in units of the weights: gradients, two moments of Adam, and two copies of weights and
moments, to roll an update back and to save the last complete iteration."""

_CGROUP = Path("/sys/fs/cgroup")
_UNITS = ("bytes", "KiB", "MiB", "GiB", "TiB", "PiB", "EiB")


def free_memory() -> int | None:
    """Return the bytes of memory that this process can still take; None where nobody knows."""
    limits = [size for size in (_free_of_machine(), _free_of_container()) if size is not None]
    return min(limits, default=None)


def check_free(needed: float, what: str, remedy: str) -> None:
    """Raise ConfigError if so many bytes are more than what is free.

    Args:
        needed: in bytes.
        what: needs them, the beginning of the message.
        remedy: the end of the message.
    """
    free = free_memory()
    if free is not None and needed > free:
        raise ConfigError(f"{what} takes about {show_size(needed)}, but {show_size(free)} are free; {remedy}")


def check_batch_memory(cfg: Config, env: Played, rounds: int) -> None:
    """Raise ConfigError if a batch does not fit into the memory that is free."""
    option = "batch_size" if cfg.collect.rounds is None else "rounds"
    value = getattr(cfg.collect, option)
    seen = describe(env)
    one_round = seen.round_bytes
    copies = BATCH_COPIES + SHARED_COPIES * (cfg.collect.workers > 0)
    check_free(
        # the critic reads all images at once, and as floats
        (copies * one_round + seen.float_bytes) * rounds,
        f"collect.{option}={value}: learning from a batch of {rounds:,} rounds of {show_size(one_round)}",
        f"lower collect.{option}, or env.num_areas where the environment has it",
    )


def check_network_memory(
    name: str,
    obs: ObsLayout,
    layout: ActionLayout,
    team_size: int,
    cfg: ModelConfig,
    rewards: RewardsConfig,
) -> None:
    """Raise ConfigError if a policy's networks do not fit into the memory that is free."""
    with torch.device("meta"), torch.random.fork_rng(devices=[]):  # shapes without numbers
        nets = make_actor(obs, layout, team_size, cfg), make_critic(obs, team_size, cfg, layout)
        streams = make_models(obs, layout, rewards, images=cfg.image_encoder)

    for stream, model in streams.items():
        size, hidden = _weights(model), list(rewards.intrinsic[stream].hidden)
        check_free(
            WEIGHT_COPIES * size,
            f"rewards.{stream}.hidden={hidden}: learning its model for {name} ({show_size(size)})",
            f"lower rewards.{stream}.hidden",
        )

    size = sum(map(_weights, nets))
    check_free(
        WEIGHT_COPIES * size,
        f"model.hidden={list(cfg.hidden)}, critic {list(cfg.critic_hidden or cfg.hidden)}: learning the "
        f"networks of {name} ({show_size(size)})",
        "lower model.hidden or model.critic_hidden",
    )


def _weights(net: nn.Module) -> int:
    """Return the bytes of a network's weights."""
    return sum(p.numel() * p.element_size() for p in net.parameters())


def show_size(size: float) -> str:
    """Return a number of bytes for reading: 3.5 GiB."""
    unit = 0
    while size >= 1024 and unit < len(_UNITS) - 1:
        size, unit = size / 1024, unit + 1
    return f"{size:,.0f} {_UNITS[unit]}" if unit == 0 or size >= 100 else f"{size:,.1f} {_UNITS[unit]}"


def is_out_of_memory(error: BaseException) -> bool:
    """Return whether an exception says that memory ran out; torch says so by a RuntimeError."""
    if isinstance(error, MemoryError) or type(error).__name__ == "OutOfMemoryError":
        return True
    return isinstance(error, RuntimeError) and "can't allocate memory" in str(error)


def _free_of_machine() -> int | None:
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
        return next(int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable:"))
    except (OSError, StopIteration):
        pass  # not Linux

    try:  # what is left out here are caches, which the system would give up: an underestimate
        return os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, OSError, ValueError):
        return None


def _free_of_container() -> int | None:
    """Return what a container's limit leaves (cgroup version 2); None without a limit."""
    try:
        limit = (_CGROUP / "memory.max").read_text().strip()
        used = int((_CGROUP / "memory.current").read_text())
        stat = dict(line.split() for line in (_CGROUP / "memory.stat").read_text().splitlines())
        # Files in the cache count as used there, but the system gives up the inactive ones when asked.
        return None if limit == "max" else int(limit) - used + int(stat.get("inactive_file", 0))
    except (OSError, ValueError):
        return None
