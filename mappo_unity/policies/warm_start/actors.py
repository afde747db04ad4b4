"""Actors of ours that play as ONNX files do."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from mlagents_envs.base_env import BehaviorSpec

from mappo_unity.errors import ConfigError
from mappo_unity.learning.networks.actor_critic import PerMember, UnityActor, make_actor
from mappo_unity.learning.networks.distributions import ActionLayout
from mappo_unity.learning.networks.encoders import ObsLayout
from mappo_unity.policies.policy import model_from_saved
from mappo_unity.policies.warm_start.agreement import check_agreement
from mappo_unity.policies.warm_start.from_onnx import actor_tensors
from mappo_unity.policies.warm_start.onnx_network import OnnxNetwork, read_network
from mappo_unity.policies.warm_start.tensors import Row, copy_fitting

NETWORK = "module.0.module."  # names of an actor's network in the actor's state_dict


def copy_network(
    network: OnnxNetwork, actor: UnityActor, sensors: Sequence[Sequence[int]]
) -> tuple[list[Row], float | None]:
    """Copy what fits of a file's network into an actor.

    Args:
        network: of the file.
        actor: what is copied into; where members have networks of their own, all of them begin alike.
        sensors: shapes of the behavior's sensors.

    Returns:
        A row for each tensor of the actor; where all of them were copied the largest difference between its
        actions and onnxruntime's, else None.

    Raises:
        ConfigError: they differ, though everything fits.
    """
    net: Any = actor[0].module
    members = (
        {f"nets.{i}.": member for i, member in enumerate(net.nets)}
        if isinstance(net, PerMember)
        else {"": net}
    )

    tensors: dict[str, torch.Tensor] = {}
    misfits: dict[str, str] = {}
    for prefix, member in members.items():
        own, why = actor_tensors(network, member, sensors)
        tensors |= {NETWORK + prefix + n: torch.tensor(values) for n, values in own.items()}
        misfits |= {NETWORK + prefix + n: reason for n, reason in why.items()}

    rows = copy_fitting(actor, "actor", tensors, misfits)
    if any(row.reason for row in rows):
        return rows, None
    return rows, max(check_agreement(network, member, sensors) for member in members.values())


def actor_from_onnx(path: Path, spec: BehaviorSpec, device: str = "cpu") -> UnityActor:
    """Return an actor with the network of an ONNX file, to play a behavior.

    Raises:
        ConfigError: the file cannot be read as a network of ours, or does not fit the behavior.
    """
    network = read_network(path)
    model = model_from_saved(network.options)
    actions = ActionLayout.from_spec(spec.action_spec, model.flatten_branches)
    actor = make_actor(ObsLayout.from_specs(spec.observation_specs), actions, 1, model)

    rows, error = copy_network(network, actor, [list(sensor.shape) for sensor in spec.observation_specs])
    if error is None:
        wrong = next(row for row in rows if row.reason)
        raise ConfigError(f"{path} does not fit: {wrong.name}: {wrong.reason}")
    return actor.to(device).eval()
