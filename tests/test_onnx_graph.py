"""ONNX graphs: the contract of Unity's own files, and the same play as torch."""

import math

import numpy as np
import onnx
import pytest
import torch
from onnx_fakes import data_of, inputs, make

from mappo_unity import keys
from mappo_unity.config.schema import (
    Activation,
    DistributionKind,
    GoalKind,
    MemoryKind,
    ModelConfig,
)
from mappo_unity.learning.networks.actor_critic import make_actor
from mappo_unity.learning.networks.distributions import ActionLayout
from mappo_unity.learning.networks.encoders import ObsLayout
from mappo_unity.learning.networks.images import MIN_SIDES
from mappo_unity.policies.onnx_check import compare
from mappo_unity.policies.onnx_graph import ExportError, build_model
from mappo_unity.policies.onnx_policy import open_session

WALL_JUMP = [3, 3, 3, 2]


# --- the contract of Unity's own files


def values(kind):
    """Return names, element types, whether and how each dimension is fixed."""
    rows = []
    for info in kind:
        tensor = info.type.tensor_type
        dims = [d.dim_value if d.HasField("dim_value") else "symbolic" for d in tensor.shape.dim]
        rows.append((info.name, onnx.TensorProto.DataType.Name(tensor.elem_type), dims))
    return rows


@pytest.mark.parametrize(
    "file, sensors, continuous, branches",
    [
        ("3DBall", [[8]], 2, []),
        ("Walker", [[243]], 39, []),
        ("SmallWallJump", [[210], [210], [24]], 0, WALL_JUMP),
    ],
)
def test_the_graph_is_that_of_unitys_own_files(shared, file, sensors, continuous, branches):
    unity = onnx.load(shared / "oracle" / f"{file}.onnx")
    actor = make(sensors, continuous, branches, activation=Activation.silu, normalize_obs=not branches)
    ours = onnx.load_from_string(data_of(actor, sensors))

    assert values(ours.graph.input) == values(unity.graph.input)
    assert values(ours.graph.output) == values(unity.graph.output)
    assert {i.type.tensor_type.shape.dim[0].dim_param for i in ours.graph.input} == {"batch"}
    assert [(o.domain, o.version) for o in ours.opset_import] == [("", 9)]
    assert ours.ir_version == 4
    operators = {node.op_type for node in ours.graph.node}
    assert operators <= {node.op_type for node in unity.graph.node}  # which Unity surely imports
    assert operators & {"RandomNormalLike", "Multinomial"}  # sampled in the graph

    feed = {name: np.ones((2, dims[1]), np.float32) for name, _, dims in values(ours.graph.input)}
    constants = [name for name, _, dims in values(ours.graph.output) if "symbolic" not in dims]
    theirs = open_session(unity.SerializeToString(), file).run(constants, feed)
    found = open_session(ours.SerializeToString(), file).run(constants, feed)
    assert len(constants) == 3
    for name, a, b in zip(constants, found, theirs):
        assert a.dtype == b.dtype and np.array_equal(a, b), name


def test_a_hybrid_policy_has_both_kinds_of_outputs_in_ml_agents_order():
    model = build_model(make([[5]], 2, [3])[0].module, [[5]], "Hybrid", {"agent_steps": "7"})
    assert [o.name for o in model.graph.output] == [
        *("version_number", "memory_size"),
        *("continuous_actions", "continuous_action_output_shape", "deterministic_continuous_actions"),
        *("discrete_actions", "discrete_action_output_shape", "deterministic_discrete_actions"),
    ]
    assert {p.key: p.value for p in model.metadata_props} == {"behavior_name": "Hybrid", "agent_steps": "7"}
    assert model.producer_name == "mappo-unity" and model.graph.name == "Hybrid"


# --- the same play as torch


CASES = {
    "tanh": ([[8]], 2, [], {}),
    "relu": ([[8]], 2, [], {"activation": Activation.relu}),
    "silu": ([[8]], 2, [], {"activation": Activation.silu}),
    "elu": ([[8]], 2, [], {"activation": Activation.elu}),
    "not normalised": ([[8]], 2, [], {"normalize_obs": False}),
    "several sensors": ([[3], [4], [1]], 1, [], {}),
    "branches": ([[6]], 0, WALL_JUMP, {}),
    "joint branches": ([[6]], 0, [3, 2, 2], {"joint": True}),
    "hybrid": ([[3], [2]], 2, [3, 2], {}),
    "hybrid, joint": ([[3], [2]], 2, [3, 2], {"joint": True}),
    "grid": ([[3, 6, 7], [4]], 0, [3], {}),
    "image alone": ([[3, 24, 20]], 2, [], {}),
    "layer norms": ([[3, 6, 7], [4]], 2, [3], {"layer_norm": True}),
    "layer norms alone": ([[4]], 2, [], {"layer_norm": True, "normalize_obs": False}),
    "squashed": ([[8]], 2, [], {"action_distribution": DistributionKind.tanh_normal, "head_scale": 20}),
    "squashed, hybrid": ([[8]], 2, [3, 2], {"action_distribution": DistributionKind.tanh_normal}),
    "entities": ([[5, 3]], 2, [], {}),
    "entities and more": ([[4], [5, 3], [3, 22, 20], [7, 2], [2]], 2, [3], {}),
    "entities, layer norms": ([[4], [5, 3]], 2, [], {"layer_norm": True}),
    "goal": ([[4], [2], [6]], 2, [3], {"goals": [False, True, False], "goal_conditioning": GoalKind.hyper}),
    "goals of every kind": (
        *([[4], [3, 8, 8], [5, 3], [2]], 2, []),
        {"goals": [False, True, True, True], "goal_conditioning": GoalKind.hyper, "layer_norm": True},
    ),
    "goal, one hidden layer": (
        *([[4]], 2, []),
        {"goals": [True], "goal_conditioning": GoalKind.hyper, "hidden": [16]},
    ),
    **{
        f"image, {kind.value}": ([[3, side, side + 4], [side + 1, side, 1]], 2, [], {"image_encoder": kind})
        for kind, side in MIN_SIDES.items()
    },
    "image, channels last": ([[4], [22, 20, 3], [2]], 2, [], {}),
}


@pytest.mark.parametrize("name", CASES)
def test_a_model_plays_as_its_actor(name):
    sensors, continuous, branches, options = CASES[name]
    actor, sample = make(sensors, continuous, branches, **options), inputs(sensors, branches)
    assert compare(data_of(actor, sensors), actor, sensors, sample) <= 1e-5


def test_cells_of_an_lstm_that_grew_large_are_compared_by_their_digits():
    torch.manual_seed(0)
    sensors, sample = [[6]], inputs([[6]], [3])
    cfg = ModelConfig(hidden=[32], memory=MemoryKind.lstm, memory_size=16)
    actor = make_actor(ObsLayout(6), ActionLayout(0, (3,)), 1, cfg)
    # of cells like these float32 has steps of 1e-3
    hidden, cells = torch.randn(2, len(sample[keys.OBS]), 8).split(1)
    sample[keys.MEMORY] = torch.cat([hidden.tanh(), cells * 1e4], -1).squeeze(0)
    assert compare(data_of(actor, sensors), actor, sensors, sample) <= 1e-5


def test_the_comparison_itself_is_not_blind():
    """What `compare` is told the model gives is what the model gives: worked by hand, beside it."""
    sensors = [[3], [2]]
    actor, sample = make(sensors, 1, [3]), inputs(sensors, [3], rows=5)
    params = actor[0].module(sample["observation"]).detach().numpy()
    mask = sample["action_mask"].numpy()
    obs = sample["observation"].numpy()
    feed = {"obs_0": obs[:, :3], "obs_1": obs[:, 3:], "action_masks": mask.astype(np.float32)}
    names = ["deterministic_continuous_actions", "deterministic_discrete_actions"]
    mean, branch = open_session(data_of(actor, sensors), "test").run(names, feed)
    np.testing.assert_allclose(mean[:, 0], np.clip(params[:, 0], -3, 3) / 3, atol=1e-5)
    assert branch[:, 0].tolist() == np.where(mask, params[:, 2:], -np.inf).argmax(1).tolist()
    assert len(set(branch[:, 0].tolist())) > 1  # not a constant


def tampered(actor, change):
    other = make([[6]], actor[0].module.layout.continuous, actor[0].module.layout.branches)
    other.load_state_dict(actor.state_dict())
    with torch.no_grad():
        change(other[0].module)
    return other


@pytest.mark.parametrize(
    "change, message",
    [
        (lambda net: net.net[-1].bias.add_(1e-3), "deterministic actions differ by"),
        (lambda net: net.encoder.norm.mean.add_(1e-2), "deterministic actions differ by"),
        (lambda net: net.log_std.add_(0.3), "samples other continuous actions"),
        (lambda net: net.net[-1].bias.fill_(math.nan), "deterministic actions differ by nan"),
    ],
)
def test_a_model_that_plays_otherwise_is_refused(change, message):
    actor, sample = make([[6]], 2), inputs([[6]])
    with pytest.raises(ExportError, match=message):
        compare(data_of(tampered(actor, change), [[6]]), actor, [[6]], sample)


def test_a_model_that_samples_other_branches_is_refused():
    actor, sample = make([[6]], 0, [4]), inputs([[6]], [4])
    model = build_model(actor[0].module, [[6]], "Fake")
    draw = next(n for n in model.graph.node if n.op_type == "Multinomial")
    log = next(n for n in model.graph.node if n.op_type == "Log")
    draw.input[0] = log.input[0]  # probabilities where log-probabilities belong
    with pytest.raises(ExportError, match="forbidden|samples other actions of branch 0"):
        compare(model.SerializeToString(), actor, [[6]], sample)


def draws(actor, count, mask=None):
    """Return that many sampled actions for an observation of zeros."""
    feed = {"obs_0": np.zeros((count, 2), np.float32)}
    if mask is not None:
        feed["action_masks"] = np.tile(np.array(mask, np.float32), (count, 1))
    name = "discrete_actions" if mask is not None else "continuous_actions"
    return open_session(data_of(actor, [[2]]), "test", seed=5).run([name], feed)[0]


def test_sampled_continuous_actions_are_clipped_normals():
    """clip(1 + 2 N(0, 1), +-3) / 3: P(1) = 1 - Phi(1), P(-1) = Phi(-2), median 1/3."""
    actor = make([[2]], 1, normalize_obs=False)
    net = actor[0].module
    with torch.no_grad():
        net.net[-1].weight.zero_()
        net.net[-1].bias.fill_(1.0)
        net.log_std.fill_(math.log(2.0))
    actions = draws(actor, 40_000)
    assert np.abs(actions).max() == 1.0
    assert np.mean(actions == 1) == pytest.approx(0.1587, abs=0.01)
    assert np.mean(actions == -1) == pytest.approx(0.0228, abs=0.004)
    assert np.median(actions) == pytest.approx(1 / 3, abs=0.02)


def test_sampled_branches_follow_their_probabilities_and_masks():
    actor = make([[2]], 0, [3], normalize_obs=False)
    net = actor[0].module
    with torch.no_grad():
        net.net[-1].weight.zero_()
        net.net[-1].bias.copy_(torch.log(torch.tensor([0.5, 0.3, 0.2])))
    free = np.bincount(draws(actor, 40_000, [1, 1, 1])[:, 0], minlength=3) / 40_000
    np.testing.assert_allclose(free, [0.5, 0.3, 0.2], atol=0.012)
    masked = np.bincount(draws(actor, 40_000, [0, 1, 1])[:, 0], minlength=3) / 40_000
    np.testing.assert_allclose(masked, [0.0, 0.6, 0.4], atol=0.012)
    assert masked[0] == 0


def test_sampled_squashed_actions_are_tanh_of_normals():
    """tanh(1 + 2 N(0, 1)): median tanh(1), P(< 0) = Phi(-1/2); a raw output of 0 is the initial deviation."""
    kind = DistributionKind.tanh_normal
    actor = make([[2]], 1, normalize_obs=False, action_distribution=kind, init_log_std=math.log(2.0))
    net = actor[0].module
    with torch.no_grad():
        net.net[-1].weight.zero_()
        net.net[-1].bias.copy_(torch.tensor([1.0, 0.0]))
    actions = draws(actor, 40_000)
    assert np.abs(actions).max() <= 1.0
    assert np.median(actions) == pytest.approx(math.tanh(1.0), abs=0.02)
    assert np.mean(actions < 0) == pytest.approx(0.3085, abs=0.012)


def test_images_reach_a_model_channels_first():
    sensors = [[22, 20, 3]]
    actor = make(sensors, 1)
    sample = inputs(sensors, rows=3)
    session = open_session(data_of(actor, sensors), "test")
    assert session.get_inputs()[0].shape == ["batch", 3, 22, 20]
    feed = {"obs_0": np.ascontiguousarray(sample["obs_0"].numpy().transpose(0, 3, 1, 2))}
    found = session.run(["deterministic_continuous_actions"], feed)[0]
    mean = actor[0].module(sample["obs_0"])[:, :1].detach().numpy()
    np.testing.assert_allclose(found, np.clip(mean, -3, 3) / 3, atol=1e-5)


# --- what cannot be exported


def test_parts_that_cannot_be_exported_are_named():
    actor = make([[4]], 2)
    actor[0].module.net.insert(1, torch.nn.Softplus())
    with pytest.raises(
        ExportError, match=r"layer net\.1 of the policy network is a Softplus.*these can: .*Tanh"
    ):
        data_of(actor, [[4]])
    actor = make([[4]], 2)
    actor[0].module.memory = torch.nn.GRU(4, 4)
    with pytest.raises(ExportError, match="'memory': 'GRU'"):
        data_of(actor, [[4]])


def test_a_network_for_each_member_is_refused():
    actor = make([[4]], 2, team_size=2, share_parameters=False)
    with pytest.raises(ExportError, match="model.share_parameters=true"):
        data_of(actor, [[4]])
