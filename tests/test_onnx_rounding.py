"""Exports compared where float32 loses digits: observations far from zero that nothing normalises."""

import copy
import math

import pytest
import torch
from onnx_fakes import data_of, inputs, make

from mappo_unity import keys
from mappo_unity.config.schema import Activation, DistributionKind, MemoryKind, ModelConfig
from mappo_unity.learning.networks.actor_critic import make_actor
from mappo_unity.learning.networks.distributions import ActionLayout
from mappo_unity.learning.networks.encoders import ObsLayout
from mappo_unity.policies.onnx_check import compare
from mappo_unity.policies.onnx_graph import ExportError

FAR = {
    "continuous": ([[6]], 2, [], {"activation": Activation.relu}),
    "squashed": (
        [[6]],
        1,
        [],
        {"activation": Activation.elu, "action_distribution": DistributionKind.tanh_normal},
    ),
    "branches": ([[6]], 0, [3, 2], {"activation": Activation.silu}),
}


def far_from_zero(name, far):
    """Return sensors, an actor whose means are about N(0, 1), and observations that far from zero."""
    sensors, continuous, branches, options = FAR[name]
    actor = make(sensors, continuous, branches, normalize_obs=False, **options)
    sample = inputs(sensors, branches)
    sample[keys.OBS] = torch.randn(40, 6) + far

    head = actor[0].module.net[-1]
    with torch.no_grad():
        means = actor[0].module.net(sample[keys.OBS])
        head.weight /= means.std(0)[:, None]
        head.bias.copy_((head.bias - means.mean(0)) / means.std(0))
    return sensors, actor, sample


@pytest.mark.parametrize("far", [100.0, 1000.0, 10000.0])
@pytest.mark.parametrize("name", FAR)
def test_what_float32_rounds_of_observations_far_from_zero_is_no_difference(name, far):
    sensors, actor, sample = far_from_zero(name, far)
    assert compare(data_of(actor, sensors), actor, sensors, sample) <= 1e-6 * far

    for amount in (1.0, math.nan):
        wrong = copy.deepcopy(actor)
        with torch.no_grad():
            wrong[0].module.net[-1].bias[0] += amount
        with pytest.raises(ExportError, match="deterministic actions differ by"):
            compare(data_of(wrong, sensors), actor, sensors, sample)


def test_of_a_memory_far_from_zero_too():
    torch.manual_seed(0)
    cfg = ModelConfig(hidden=[32], memory=MemoryKind.traces, normalize_obs=False)
    actor = make_actor(ObsLayout(6), ActionLayout(2, ()), 1, cfg)
    sample = {keys.OBS: torch.randn(40, 6) + 1000, keys.MEMORY: torch.zeros(40, actor.memory_size)}
    assert compare(data_of(actor, [[6]]), actor, [[6]], sample) <= 1e-2
