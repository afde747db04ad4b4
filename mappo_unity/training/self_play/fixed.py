"""Opponents that are always in the pool, from files: `self_play.fixed`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from mlagents_envs.base_env import BehaviorSpec

from mappo_unity import keys
from mappo_unity.errors import ConfigError
from mappo_unity.learning.networks.actor_critic import UnityActor
from mappo_unity.learning.networks.distributions import CONTINUOUS_LIMIT
from mappo_unity.learning.networks.opponents import Player, RandomActor
from mappo_unity.policies.layouts import check_layout
from mappo_unity.policies.onnx_policy import file_in
from mappo_unity.policies.policy import actor_of
from mappo_unity.policies.policy_files import Kind, choose_checkpoint, locate
from mappo_unity.policies.warm_start.actors import actor_from_onnx
from mappo_unity.runs import checkpoint

OPTION = "self_play.fixed"


def load_fixed(
    where: str, specs: Mapping[str, BehaviorSpec], actors: Mapping[str, UnityActor], device: str
) -> dict[str, Player]:
    """Return who plays for an entry of `self_play.fixed`, by policy name.

    Args:
        where: the entry.
        specs: of the behaviors that it is to play, by full name; of two sides one is enough.
        actors: of the policy names, in whose places they play.
        device: on which they play.

    Raises:
        ConfigError: nothing is there, or nothing that plays these behaviors.
    """
    source = locate(where, OPTION)
    names = {keys.policy_name(behavior): behavior for behavior in specs}
    if source.kind is Kind.random:
        return {name: RandomActor(actors[name], CONTINUOUS_LIMIT, device) for name in names}

    if source.kind in (Kind.onnx, Kind.onnx_folder):
        files = {name: _file_of(source.path, name, len(names)) for name in names}
        return {name: actor_from_onnx(files[name], specs[names[name]], device) for name in names}

    path = choose_checkpoint(source.path, OPTION)
    state = checkpoint.load(path)
    for behavior in names.values():
        check_layout(f"{OPTION}: checkpoint {path}", state["layout"], behavior, specs[behavior])
    return {name: actor_of(state, name).to(device) for name in names}


def _file_of(path: Path, name: str, count: int) -> Path:
    """Return the ONNX file of a policy name: the file itself where there is one name only."""
    if path.is_file():
        if count == 1:
            return path
        raise ConfigError(
            f"{OPTION}: {path} holds one policy, and the environment has {count}: name a folder with "
            "NAME.onnx for each"
        )
    own = file_in(path, name)
    if not own.is_file():
        raise ConfigError(f"{OPTION}: the folder {path} has no {own.name}")
    return own
