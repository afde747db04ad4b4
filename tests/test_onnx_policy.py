"""ONNX files as policies: those that Unity trained, and what is no such file."""

import numpy as np
import onnx
import pytest
import torch
from fakes import behavior_spec
from mlagents_envs.base_env import (
    ActionSpec,
    BehaviorSpec,
    DecisionSteps,
    DimensionProperty,
    ObservationSpec,
    ObservationType,
)
from onnx_fakes import data_of, make, official_policy

from mappo_unity.errors import ConfigError
from mappo_unity.policies.onnx_policy import OnnxFolder, OnnxPolicy

WALL_JUMP = (3, 3, 3, 2)


def decisions(sizes, branches=(), rows=6, seed=0, forbid=True):
    """Return random decisions of a behavior with vector sensors."""
    rng = np.random.default_rng(seed)
    mask = None
    if branches:
        mask = [rng.random((rows, n)) < (0.4 if forbid else 0) for n in branches]
        for part in mask:
            part[np.arange(rows), rng.integers(part.shape[1], size=rows)] = False
    obs = [rng.normal(size=(rows, n)).astype(np.float32) for n in sizes]
    zeros = np.zeros(rows, np.float32)
    return DecisionSteps(obs, zeros, np.arange(rows), mask, np.zeros(rows, int), zeros)


def spec_of(sizes, action):
    sensors = [
        ObservationSpec((n,), (DimensionProperty.NONE,), ObservationType.DEFAULT, f"s{i}")
        for i, n in enumerate(sizes)
    ]
    return BehaviorSpec(sensors, action)


@pytest.mark.parametrize(
    "file, sizes, action",
    [
        ("3DBall", [8], ActionSpec(2, ())),
        ("SmallWallJump", [210, 210, 24], ActionSpec(0, WALL_JUMP)),
        ("SoccerTwos", [264, 72], ActionSpec(0, (3, 3, 3))),
        ("DungeonEscape", [10, 360, 1], ActionSpec(0, (7,))),
    ],
)
def test_unitys_files_play_as_run_policy_plays_them(shared, file, sizes, action):
    path = shared / "oracle" / f"{file}.onnx"
    ours, theirs = OnnxPolicy(path, deterministic=True), official_policy(shared, path, deterministic=True)
    spec = spec_of(sizes, action)
    for seed in range(5):
        steps = decisions(sizes, action.discrete_branches, seed=seed)
        a, b = ours.act("B?team=0", steps, spec), theirs.act(steps, spec)
        np.testing.assert_allclose(a.continuous, b.continuous, atol=1e-6)
        assert np.array_equal(a.discrete, b.discrete)


@pytest.mark.parametrize(
    "file, sizes, branches",
    [("SoccerTwos", [264, 72], (3, 3, 3)), ("SmallWallJump", [210, 210, 24], (3, 3, 3, 2))],
)
def test_forbidden_actions_are_never_drawn(shared, file, sizes, branches):
    policy = OnnxPolicy(shared / "oracle" / f"{file}.onnx", deterministic=False)
    spec = spec_of(sizes, ActionSpec(0, branches))
    steps = decisions(sizes, branches, rows=200)
    for _ in range(5):
        chosen = policy.act("B", steps, spec).discrete
        for branch, forbidden in enumerate(steps.action_mask):
            assert not forbidden[np.arange(200), chosen[:, branch]].any()


def test_log_probabilities_are_drawn_from_in_format_2(shared):
    """The share of each branch is the probability that the file itself gives."""
    policy = OnnxPolicy(shared / "oracle" / "SoccerTwos.onnx", deterministic=False, seed=1)
    one = decisions([336], (3, 3, 3), rows=1)
    feed = {"vector_observation": one.obs[0], "action_masks": 1.0 - np.concatenate(one.action_mask, 1)}
    feed = {name: array.astype(np.float32) for name, array in feed.items()}
    log_probs = policy.session.run(["discrete_actions"], feed)[0]
    many = DecisionSteps(
        [np.repeat(one.obs[0], 20_000, 0)],
        np.zeros(20_000),
        np.arange(20_000),
        [np.repeat(m, 20_000, 0) for m in one.action_mask],
        np.zeros(20_000, int),
        np.zeros(20_000),
    )
    chosen = policy.act("B", many, spec_of([336], ActionSpec(0, (3, 3, 3)))).discrete
    for branch in range(3):
        share = np.bincount(chosen[:, branch], minlength=3) / 20_000
        np.testing.assert_allclose(share, np.exp(log_probs[0, 3 * branch : 3 * branch + 3]), atol=0.015)


def test_recurrent_files_remember_until_the_episode_ends(shared):
    path = shared / "oracle" / "Hallway.onnx"
    ours, theirs = OnnxPolicy(path, deterministic=False), official_policy(shared, path, deterministic=False)
    spec = spec_of([105, 3], ActionSpec(0, (5,)))
    for seed in range(3):
        steps = decisions([105, 3], (5,), seed=seed, forbid=False)
        ours.act("Hallway?team=0", steps, spec)
        theirs.act(steps, spec)
        for agent in range(6):
            mine, other = ours._memory["Hallway?team=0", agent], theirs.memory[agent]
            assert np.abs(mine).max() > 0
            np.testing.assert_allclose(mine, other, atol=1e-6)
        if seed == 1:
            ours.forget("Hallway?team=0", [2])
            theirs.forget([2])
    assert ("Hallway?team=0", 2) in ours._memory
    with pytest.raises(ConfigError, match="no output deterministic_discrete_actions"):
        OnnxPolicy(path, deterministic=True)


def test_the_same_seed_draws_the_same(ball):
    steps, spec = decisions([8]), spec_of([8], ActionSpec(2, ()))
    a, b, c = (OnnxPolicy(ball, False, seed).act("3DBall", steps, spec).continuous for seed in (4, 4, 5))
    assert np.array_equal(a, b) and not np.array_equal(a, c)


@pytest.fixture
def ball(tmp_path):
    """Return a file for 3DBall's sensors and actions."""
    path = tmp_path / "ball.onnx"
    path.write_bytes(data_of(make([[8]], 2), [[8]], "3DBall"))
    return path


def test_a_file_that_does_not_fit_says_what_both_are(ball, tmp_path):
    policy = OnnxPolicy(ball, False)
    wrong = behavior_spec(5, ActionSpec(2, (3,)))
    with pytest.raises(
        ConfigError,
        match=r"obs_0 \[8\], continuous_actions \[2\], but .* obs_0 \[5\], .*discrete_actions \[1\]",
    ):
        policy.act("3DBall?team=0", decisions([5], (3,)), wrong)
    with pytest.raises(ConfigError, match="plays '3DBall', but the environment has 'Other"):
        policy.act("Other?team=0", decisions([8]), spec_of([8], ActionSpec(2, ())))
    (tmp_path / "text.onnx").write_text("no model")
    with pytest.raises(ConfigError, match="text.onnx is no ONNX model that onnxruntime can run"):
        OnnxPolicy(tmp_path / "text.onnx", False)
    with pytest.raises(ConfigError, match="does not exist"):
        OnnxPolicy(tmp_path / "none.onnx", False)


def test_a_folder_plays_each_behavior_with_its_own_file(tmp_path):
    """The two files differ in a bias of 0.3, so their means differ by 0.1."""
    spec, steps = spec_of([4], ActionSpec(1, ())), decisions([4])
    for bias, name in ((0.0, "Small"), (0.3, "Big er")):
        actor = make([[4]], 1)
        with torch.no_grad():
            actor[0].module.net[-1].weight.zero_()
            actor[0].module.net[-1].bias.fill_(bias)
        (tmp_path / f"{name.replace(' ', '_')}.onnx").write_bytes(data_of(actor, [[4]], name))
    folder = OnnxFolder(tmp_path, deterministic=True)
    assert np.allclose(folder.act("Small?team=0", steps, spec).continuous, 0.0)
    assert np.allclose(folder.act("Big er?team=1", steps, spec).continuous, 0.1)
    with pytest.raises(
        ConfigError, match="'Huge' needs a file .*Huge.onnx; there are Big_er.onnx, Small.onnx"
    ):
        folder.act("Huge", steps, spec)


def test_a_model_of_another_kind_is_refused(tmp_path):
    info = onnx.helper.make_tensor_value_info
    graph = onnx.helper.make_graph(
        [onnx.helper.make_node("Identity", ["x"], ["y"])],
        "other",
        [info("x", onnx.TensorProto.FLOAT, [1])],
        [info("y", onnx.TensorProto.FLOAT, [1])],
    )
    opset = [onnx.helper.make_opsetid("", 9)]
    onnx.save(onnx.helper.make_model(graph, ir_version=4, opset_imports=opset), tmp_path / "other.onnx")
    with pytest.raises(ConfigError, match=r"no ML-Agents model of format 2 or 3: its inputs are \['x'\]"):
        OnnxPolicy(tmp_path / "other.onnx", False)
