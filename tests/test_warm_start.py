"""Warm starts: ONNX files of Unity's and of ours as actors, runs and checkpoints, frozen behaviors."""

from __future__ import annotations

import csv
import shutil
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import onnx
import pytest
import torch
from omegaconf import OmegaConf
from onnx_fakes import data_of, inputs, make
from test_onnx_graph import CASES

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "scripts"))

import check_warm_starts

from mappo_unity import keys
from mappo_unity.cli import train_main
from mappo_unity.config.schema import ModelConfig
from mappo_unity.errors import ConfigError
from mappo_unity.learning.networks.actor_critic import make_actor
from mappo_unity.learning.networks.distributions import ActionLayout
from mappo_unity.learning.networks.encoders import ObsLayout, running_norms
from mappo_unity.policies.onnx_check import compare
from mappo_unity.policies.onnx_policy import OnnxPolicy
from mappo_unity.policies.policy import ActorPolicy
from mappo_unity.policies.warm_start import agreement
from mappo_unity.policies.warm_start.onnx_network import read_network
from mappo_unity.policies.warm_start.start import _from_onnx
from mappo_unity.runs import checkpoint
from mappo_unity.scenes import make_scene

UNITY = {
    # file: scene, behavior, sensors, continuous, branches
    "3DBall": ("3DBall", "3DBall", [[8]], 2, ()),
    "Walker": ("Walker", "Walker", [[243]], 39, ()),
    "Hallway": ("Hallway", "Hallway", [[105], [3]], 0, (5,)),
    "SoccerTwos": ("SoccerTwos", "SoccerTwos", [[264], [72]], 0, (3, 3, 3)),
    "DungeonEscape": ("DungeonEscape", "DungeonEscape", [[360], [10], [1]], 0, (7,)),
    "SmallWallJump": ("WallJump", "SmallWallJump", [[210], [210], [24]], 0, (3, 3, 3, 2)),
    "BigWallJump": ("WallJump", "BigWallJump", [[210], [210], [24]], 0, (3, 3, 3, 2)),
}


def started(
    path: Path, sensors: Any, continuous: int, branches: Any, team_size: int = 1, **model: Any
) -> Any:
    """Return an actor of the file's shape that begins with the file, and the rows said about it."""
    torch.manual_seed(5)
    options: Any = OmegaConf.to_object(
        OmegaConf.merge(OmegaConf.structured(ModelConfig), read_network(path).options | model)
    )
    layout = ActionLayout(continuous, tuple(branches), options.flatten_branches and len(branches) > 1)
    actor = make_actor(ObsLayout.from_shapes(sensors), layout, team_size, options)
    _, rows = _from_onnx(path, SimpleNamespace(actor=actor), {"sensors": sensors})  # type: ignore[arg-type]
    return actor, rows


def skipped(rows: Any) -> list[str]:
    return [row.name for row in rows if row.reason]


def params_of(actor: Any, sample: dict[str, torch.Tensor]) -> torch.Tensor:
    entries = [sample[key] for key in [*actor.obs_keys, *([keys.MEMORY] if actor.has_memory else [])]]
    with torch.no_grad():
        out = actor[0].module(*entries)
    return out[0] if actor.has_memory else out


# --- files of ours


@pytest.mark.parametrize("name", CASES)
def test_an_exported_actor_comes_back(name: str, tmp_path: Path) -> None:
    sensors, continuous, branches, options = CASES[name]
    actor, path = make(sensors, continuous, branches, **options), tmp_path / "own.onnx"
    path.write_bytes(data_of(actor, sensors))
    if name.startswith(("entit", "goal")):
        with pytest.raises(ConfigError, match="can be read"):
            read_network(path)
        return

    again, rows = started(path, sensors, continuous, branches)
    assert skipped(rows) == ["critic"]
    sample = inputs(sensors, branches)
    torch.testing.assert_close(params_of(again, sample), params_of(actor, sample), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize(
    ("model", "size", "image"),
    [
        ({"memory": "lstm", "memory_size": 12}, 12, []),
        ({"memory": "gru", "memory_size": 12}, 12, []),
        ({"memory": "traces"}, 16, []),
        ({"memory": "traces", "memory_traces": [0.7], "memory_traced": [5, 2, 0, 1]}, 4, [[11, 9, 2]]),
        ({"memory": "traces", "memory_traced": [3, 2], "normalize_obs": False}, 6, [[11, 9, 2]]),
    ],
)
def test_an_exported_memory_comes_back(
    model: dict[str, Any], size: int, image: list[list[int]], tmp_path: Path
) -> None:
    sensors, path = [[3], *image, [4]], tmp_path / "own.onnx"
    torch.manual_seed(3)
    cfg = OmegaConf.merge(OmegaConf.structured(ModelConfig), {"hidden": [16]} | model)
    options: Any = OmegaConf.to_object(cfg)
    actor = make_actor(ObsLayout.from_shapes(sensors), ActionLayout(2, (3,)), 1, options)
    with torch.no_grad():
        for parameter in actor.parameters():
            parameter.normal_(std=0.2)  # larger ones make sums of which float32 has fewer digits
    for norm in running_norms(actor):
        norm.update(torch.randn(500, 7) * 3 + 1)
    data = data_of(actor, sensors)
    path.write_bytes(data)

    again, rows = started(path, sensors, 2, [3])
    assert skipped(rows) == ["critic"] and again.memory_size == size
    sample = inputs(sensors, [3]) | {keys.MEMORY: torch.randn(40, size)}
    assert compare(data, actor, sensors, sample) <= 1e-5
    torch.testing.assert_close(params_of(again, sample), params_of(actor, sample), rtol=1e-5, atol=1e-5)


def test_members_with_networks_of_their_own_all_begin_with_the_file(tmp_path: Path) -> None:
    sensors, path = [[4]], tmp_path / "own.onnx"
    actor = make(sensors, 2)
    path.write_bytes(data_of(actor, sensors))
    team, rows = started(path, sensors, 2, [], team_size=2, share_parameters=False)
    assert skipped(rows) == ["critic"]
    obs = torch.randn(7, 2, 4)
    want = params_of(actor, {"observation": obs})
    torch.testing.assert_close(params_of(team, {"observation": obs}), want, rtol=1e-5, atol=1e-5)


def test_what_does_not_fit_is_skipped_and_the_rest_is_copied(tmp_path: Path) -> None:
    path = tmp_path / "own.onnx"
    path.write_bytes(data_of(make([[4]], 2), [[4]]))

    # another sensor: what depends on it is new, and the normaliser is new as a whole
    _, rows = started(path, [[5]], 2, [])
    assert skipped(rows) == [
        *(f"actor.encoder.norm.{part}" for part in ("mean", "var", "count", "inv_std")),
        *("actor.net.0.weight", "critic"),
    ]
    reasons = {row.name: row.reason for row in rows}
    assert reasons["actor.net.0.weight"] == "obs_0 has shape [4], the behavior's sensor 0 [5]"

    # other actions, or another width
    _, rows = started(path, [[4]], 0, [3])
    assert skipped(rows) == ["actor.net.4.weight", "actor.net.4.bias", "critic"]
    _, rows = started(path, [[4]], 2, [], hidden=[32, 16])
    assert skipped(rows) == ["actor.net.2.weight", "actor.net.2.bias", "actor.net.4.weight", "critic"]
    assert {row.name: row.reason for row in rows}["actor.net.2.weight"] == "there it is [32, 32]"


def test_a_normaliser_of_unknown_age_moves_slowly_and_ours_goes_on(tmp_path: Path) -> None:
    path, actor = tmp_path / "own.onnx", make([[4]], 2)
    for metadata, count in (({}, 1e6), ({"agent_steps": "5000"}, 5000)):
        path.write_bytes(data_of(actor, [[4]], **metadata))
        read_network.cache_clear()
        again, _ = started(path, [[4]], 2, [])
        norm = again[0].module.encoder.norm
        assert float(norm.count) == count
        own = actor[0].module.encoder.norm
        torch.testing.assert_close(norm.var, own.var, rtol=1e-4, atol=1e-6)


# --- Unity's files


def raw_outputs(path: Path, feed: dict[str, np.ndarray]) -> list[np.ndarray]:
    """Return what the file's action layers give, by onnxruntime."""
    return agreement._run(read_network(path), feed)


@pytest.mark.parametrize("file", UNITY)
def test_unitys_files_become_actors_that_play_as_they_do(shared: Path, file: str) -> None:
    _, _, sensors, continuous, branches = UNITY[file]
    path = shared / "oracle" / f"{file}.onnx"
    actor, rows = started(path, sensors, continuous, branches)
    assert skipped(rows) == ["critic"]

    # beside the check that a warm start makes itself: other observations, and plain comparisons
    rng = np.random.default_rng(7)
    vectors = [rng.normal(0, 1, (200, shape[0])).astype(np.float32) for shape in sensors]
    feed = {f"obs_{i}": values for i, values in enumerate(vectors)}
    feed["vector_observation"] = np.concatenate(vectors, 1)
    feed["action_masks"] = np.ones((200, sum(branches)), np.float32)
    sample = {keys.OBS: torch.from_numpy(feed["vector_observation"])}
    if actor.has_memory:
        feed["recurrent_in"] = rng.normal(0, 0.5, (200, 1, actor.memory_size)).astype(np.float32)
        sample[keys.MEMORY] = torch.from_numpy(feed["recurrent_in"][:, 0])

    params, found = params_of(actor, sample).numpy(), raw_outputs(path, feed)
    if continuous:
        want, mean = np.clip(found[0], -3, 3) / 3, np.clip(params[:, :continuous], -3, 3) / 3
        np.testing.assert_allclose(mean, want, rtol=0, atol=1e-5)
    else:
        logits = np.concatenate(found[: len(branches)], 1)
        # observations that no game has make logits of 80, whose float32 sums differ in the seventh digit
        scale = np.maximum(1, np.abs(logits).max(1, keepdims=True))
        np.testing.assert_allclose(params / scale, logits / scale, rtol=0, atol=1e-5)


@pytest.mark.parametrize("file", UNITY)
def test_they_choose_the_same_actions_while_they_are_played(shared: Path, file: str) -> None:
    scene, behavior, sensors, continuous, branches = UNITY[file]
    path = shared / "oracle" / f"{file}.onnx"
    actor, _ = started(path, sensors, continuous, branches)
    env = make_scene(scene, seed=3, num_areas=12 if scene == "WallJump" else 2)
    env.reset()

    # Hallway's file has no action without chance: its logits are compared
    theirs = OnnxPolicy(path, deterministic=file != "Hallway")
    compared = 0
    for _ in range(25):
        for name in env.behavior_specs:
            steps, spec = env.get_steps(name)[0], env.behavior_specs[name]
            if not len(steps):
                continue
            if keys.policy_name(name) != behavior:
                env.set_actions(name, spec.action_spec.random_action(len(steps)))
                continue

            feed = theirs._feed(name, steps, spec)
            sample = {keys.OBS: torch.from_numpy(np.concatenate(steps.obs, 1))}
            if actor.has_memory:
                sample[keys.MEMORY] = torch.from_numpy(feed["recurrent_in"][:, 0])
            params, found = params_of(actor, sample).numpy(), raw_outputs(path, feed)
            if continuous:
                want, mean = np.clip(found[0], -3, 3) / 3, np.clip(params[:, :continuous], -3, 3) / 3
                np.testing.assert_allclose(mean, want, rtol=0, atol=1e-5)
            else:
                want = np.concatenate(found[: len(branches)], 1)
                np.testing.assert_allclose(params, want, rtol=1e-5, atol=1e-5)
            compared += len(steps)

            action = theirs.act(name, steps, spec)
            if not actor.has_memory:
                layout = {
                    behavior: {"team_size": 3, "sensors": [tuple(s) for s in sensors]}
                    | {"continuous": continuous, "branches": list(branches)}
                }
                ours = ActorPolicy(layout, {behavior: actor}, True, "ours")
                ours.check = lambda *arguments: None  # type: ignore[method-assign]
                mine = ours.act(name, steps, spec)
                np.testing.assert_allclose(mine.continuous, action.continuous, rtol=0, atol=1e-5)
                assert np.array_equal(mine.discrete, action.discrete)
            env.set_actions(name, action)
        env.step()
    assert compared >= 10
    env.close()


def test_the_table_of_agreement(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """scripts/check_warm_starts.py has a row for each file, and says which one is refused."""
    (tmp_path / "3DBall.onnx").write_bytes(data_of(make([[8]], 2), [[8]]))
    (tmp_path / "Walker.onnx").write_bytes(data_of(make([[8]], 2), [[8]]))
    (tmp_path / "Chess.onnx").write_bytes(b"of a game that is not here")
    monkeypatch.setattr(sys, "argv", ["check_warm_starts.py", str(tmp_path)])
    assert check_warm_starts.main() == 1

    ball, chess, walker = capsys.readouterr().out.splitlines()[2:]
    assert "hidden=[32,32]" in ball and float(ball.split("|")[-2]) < 1e-5
    assert "no scene has this behavior" in chess
    assert "refused" in walker and "are 2 continuous and branches [], the behavior's 39 and" in walker


def test_a_game_is_trained_on_from_unitys_file(shared: Path, tmp_path: Path, capsys: Any) -> None:
    """Frozen for one batch, the policy of the file plays as well in training as by itself: 100 a ball."""
    path = shared / "oracle" / "3DBall.onnx"
    lines = ["env=3DBall", f"init_from={path}", "max_steps=13000", "ppo.critic_warmup_steps=13000"]
    lines += ["log.progress=false", "export_onnx=false", "model.init_log_std=-5", f"output_dir={tmp_path}"]
    assert train_main(lines) == 0
    out = capsys.readouterr().out
    assert "hidden=[128,128] activation=silu" in out and "copied   actor.net.0.weight" in out

    saved = OmegaConf.load(next(tmp_path.rglob("config.yaml")))
    assert saved.model.activation.lower() == "silu" and saved.model.hidden == [128, 128]
    assert saved.init_from == str(path)
    want = read_network(path)
    learner = newest(tmp_path)["learners"]["3DBall"]
    np.testing.assert_array_equal(
        learner["actor"]["module.0.module.net.0.weight"], want.layers[0].linear.weight
    )
    assert {row["critic_warmup"] for row in read_rows(tmp_path)} == {"1.0"}


# --- runs and checkpoints

TINY = [
    *("env=custom", "env.name=T", "env.factory=probes:make", "env.params.probe=ObsActionReward"),
    *("model.hidden=[8]", "collect.rounds=8", "ppo.epochs=1", "ppo.minibatch_size=64", "max_steps=256"),
    *("log.loggers=[]", "log.progress=false", "export_onnx=false"),
]


def read_rows(folder: Path) -> list[dict[str, str]]:
    return list(csv.DictReader(next(folder.rglob("metrics.csv")).open()))


def newest(folder: Path) -> dict[str, Any]:
    return checkpoint.load(sorted(folder.rglob("step_*.pt"))[-1])


def run_of(folder: Path) -> Path:
    return next(folder.rglob("config.yaml")).parent


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of a tiny environment."""
    folder = tmp_path_factory.mktemp("run")
    assert train_main([*TINY, f"output_dir={folder}"]) == 0
    return run_of(folder)


def assert_same_tensors(a: dict[str, Any], b: dict[str, Any]) -> None:
    assert a.keys() == b.keys()
    for name in a:
        assert torch.equal(a[name], b[name]), name


def test_a_run_begins_with_another_runs_networks_and_nothing_else(
    run: Path, tmp_path: Path, capsys: Any
) -> None:
    last = sorted(run.rglob("step_*.pt"))[-1]
    lines = [*TINY, f"init_from={last}", "ppo.critic_warmup_steps=10000", "seed=4", f"output_dir={tmp_path}"]
    assert train_main(lines) == 0
    out = capsys.readouterr().out
    assert f"Probe begins with {last} (256 agent steps):" in out
    assert out.count("  copied ") >= 12 and "skipped" not in out

    before, after = checkpoint.load(last)["learners"]["Probe"], newest(tmp_path)["learners"]["Probe"]
    assert_same_tensors(before["actor"], after["actor"])  # its normaliser too
    assert not torch.equal(before["critic"]["module.net.0.weight"], after["critic"]["module.net.0.weight"])
    assert int(read_rows(tmp_path)[0]["agent_steps"]) == 128  # steps begin at 0


def test_the_actor_learns_once_the_critic_is_warm(run: Path, tmp_path: Path) -> None:
    lines = [*TINY, f"init_from={run}", "ppo.critic_warmup_steps=128", f"output_dir={tmp_path}"]
    assert train_main(lines) == 0
    assert [row["critic_warmup"] for row in read_rows(tmp_path)] == ["1.0", "0.0"]
    first, last = (checkpoint.load(path) for path in sorted(tmp_path.rglob("step_*.pt")))
    key = "module.0.module.net.0.weight"
    assert not torch.equal(first["learners"]["Probe"]["actor"][key], last["learners"]["Probe"]["actor"][key])

    # the counter outlives a resume
    assert train_main([f"resume={run_of(tmp_path)}", "max_steps=384"]) == 0
    assert [row["critic_warmup"] for row in read_rows(tmp_path)] == ["1.0", "0.0", "0.0"]


def test_tensors_of_another_shape_are_skipped_and_said(run: Path, tmp_path: Path, capsys: Any) -> None:
    lines = [*TINY, f"init_from={run}", "model.critic_hidden=[9]", f"output_dir={tmp_path}"]
    assert train_main(lines) == 0
    out = capsys.readouterr().out
    assert "skipped  critic.net.0.weight" in out and "there it is [8, 1]" in out
    assert "skipped  value_norm.mean" in out and "copied   actor.net.0.weight" in out


def test_what_shapes_do_not_show_is_said(run: Path, tmp_path: Path, capsys: Any) -> None:
    lines = [*TINY, f"init_from={run}", "model.activation=silu", "ppo.normalize_values=none"]
    assert train_main([*lines, f"output_dir={tmp_path}"]) == 0
    out = capsys.readouterr().out
    assert "  note: model.activation=tanh there and silu here: what is copied computes otherwise\n" in out
    assert out.count("note: ") == 1
    assert "  skipped  critic " in out and "its values are normalised, here they are not" in out
    assert "value_norm" not in out


def test_values_that_are_not_normalised_are_not_read_as_such(tmp_path: Path, capsys: Any) -> None:
    lines = [*TINY, "ppo.normalize_values=none", f"output_dir={tmp_path / 'raw'}"]
    assert train_main(lines) == 0
    raw = run_of(tmp_path / "raw")
    for kind, is_copied in (("running", False), ("popart", True)):
        lines = [*TINY, f"init_from={raw}", f"ppo.normalize_values={kind}", f"output_dir={tmp_path / kind}"]
        capsys.readouterr()
        assert train_main(lines) == 0
        out = capsys.readouterr().out
        assert ("its values are not normalised, here they are" in out) != is_copied
        assert ("copied   critic.net.0.weight" in out) == is_copied


def test_a_run_that_began_warm_resumes_without_its_source(run: Path, tmp_path: Path) -> None:
    source = tmp_path / "source"
    shutil.copytree(run, source)
    assert train_main([*TINY, f"init_from={source}", f"output_dir={tmp_path / 'runs'}"]) == 0
    shutil.rmtree(source)
    assert train_main([f"resume={run_of(tmp_path / 'runs')}", "max_steps=384"]) == 0


def test_a_sweep_begins_every_job_warm(run: Path, tmp_path: Path, capsys: Any) -> None:
    path = tmp_path / "own.onnx"
    path.write_bytes(data_of(make([[1]], 0, [2], hidden=[5, 6]), [[1]]))
    lines = [line for line in TINY if not line.startswith("model.")]
    assert train_main(["-m", *lines, f"init_from={path}", "seed=1,2", f"output_dir={tmp_path}"]) == 0
    assert capsys.readouterr().out.count("hidden=[5,6]") == 2


# --- behaviors

WALLS = [
    *("env=WallJump", "env.num_areas=4", "model.hidden=[8]", "collect.batch_size=64", "ppo.epochs=1"),
    *("max_steps=200", "log.loggers=[]", "log.progress=false", "export_onnx=false"),
]


@pytest.fixture(scope="module")
def walls(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of two behaviors."""
    folder = tmp_path_factory.mktemp("walls")
    assert train_main([*WALLS, f"output_dir={folder}"]) == 0
    return run_of(folder)


def test_one_behavior_is_frozen_and_another_begins_anew(walls: Path, tmp_path: Path, capsys: Any) -> None:
    last = sorted(walls.rglob("step_*.pt"))[-1]
    lines = [*WALLS, f"init_from={last}", "seed=3", f"output_dir={tmp_path}"]
    lines += ["behaviors.SmallWallJump.train=false", "behaviors.BigWallJump.init_from=null"]
    assert train_main(lines) == 0
    out = capsys.readouterr().out
    assert "SmallWallJump begins with" in out and "BigWallJump begins with" not in out

    before, after = newest(walls)["learners"], newest(tmp_path)["learners"]
    assert_same_tensors(before["SmallWallJump"]["actor"], after["SmallWallJump"]["actor"])
    assert_same_tensors(before["SmallWallJump"]["critic"], after["SmallWallJump"]["critic"])
    key = "module.0.module.net.0.weight"
    assert not torch.equal(before["BigWallJump"]["actor"][key], after["BigWallJump"]["actor"][key])

    row = read_rows(tmp_path)[-1]
    assert (row["SmallWallJump/frozen"], row["BigWallJump/frozen"]) == ("1.0", "0.0")
    assert "SmallWallJump/policy_loss" not in row and "BigWallJump/policy_loss" in row
    assert train_main([f"resume={run_of(tmp_path)}", "max_steps=300"]) == 0


def test_each_behavior_has_a_file_of_its_own(shared: Path, tmp_path: Path, capsys: Any) -> None:
    oracle = shared / "oracle"
    lines = [line for line in WALLS if not line.startswith("model.")] + ["model.hidden=[8]"]
    lines += [f"behaviors.BigWallJump.init_from={oracle / 'BigWallJump.onnx'}", f"output_dir={tmp_path}"]
    assert train_main(lines) == 0
    assert "BigWallJump begins with" in capsys.readouterr().out
    model = newest(tmp_path)["model"]
    assert model["BigWallJump"]["hidden"] == [256, 256] and model["SmallWallJump"]["hidden"] == [8]

    # beside a file for all, null keeps the behavior's own shape
    lines = [line for line in WALLS if not line.startswith("model.")]
    lines += ["behaviors.SmallWallJump.model.activation=tanh"]
    lines += [f"init_from={oracle / 'BigWallJump.onnx'}", "behaviors.SmallWallJump.init_from=null"]
    assert train_main([*lines, f"output_dir={tmp_path / 'two'}"]) == 0
    model = newest(tmp_path / "two")["model"]
    assert model["BigWallJump"]["activation"] == "silu" != model["SmallWallJump"]["activation"]


# --- mistakes


def strange_model(path: Path, op: str) -> None:
    """Write a model whose only output comes from an operator that no policy of ours has."""
    node = onnx.helper.make_node(op, ["obs_0"], ["continuous_actions"])
    value = [
        onnx.helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, ["batch", 2])
        for name in ("obs_0", "continuous_actions")
    ]
    graph = onnx.helper.make_graph([node], "strange", value[:1], value[1:])
    onnx.save(onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 9)]), str(path))


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        (["init_from=nowhere.onnx"], "init_from=nowhere.onnx"),
        (["init_from="], "init_from='' must name a run folder, a checkpoint (.pt) or an ONNX file"),
        (["init_from=random"], "without init_from networks begin with random weights"),
        (["init_from=text.txt"], "init_from=text.txt is neither a checkpoint nor an ONNX file"),
        (["init_from=files"], "is a folder of ONNX files: give each behavior its own"),
        (["init_from=broken.onnx"], "broken.onnx is no ONNX model"),
        (["init_from=strange.onnx"], "strange.onnx: the means of its continuous actions come from 0 layers"),
        (["init_from=own.onnx", "model.hidden=[7]"], "model.hidden=[7] contradicts own.onnx"),
        (
            ["init_from=own.onnx", "behaviors.Probe.model.hidden=[7]"],
            "behaviors.Probe.model.hidden=[7] contra",
        ),
        (["init_from=other.onnx"], "no layer of it fits the actor of Probe"),
        (["behaviors.Probe.init_from=5"], "behaviors.Probe.init_from=5 must name"),
        (["behaviors.Probe.train=maybe"], "behaviors.Probe.train='maybe' must be true or false"),
        (["behaviors.Probe.train=false"], "nothing is learnt, since every behavior"),
        (["ppo.critic_warmup_steps=-1"], "ppo.critic_warmup_steps must be >= 0"),
    ],
)
def test_mistakes_are_told_in_a_line(
    lines: list[str], words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("text.txt").write_text("nothing")
    Path("broken.onnx").write_text("nothing")
    Path("files").mkdir()
    own = data_of(make([[1]], 0, [2]), [[1]])
    for path in ("own.onnx", "files/A.onnx"):
        Path(path).write_bytes(own)
    # of another behavior altogether, and with a memory, so that no name of a layer agrees
    Path("other.onnx").write_bytes(data_of(make([[3]], 4, [], hidden=[5, 5]), [[3]]))
    strange_model(Path("strange.onnx"), "Tanh")
    read_network.cache_clear()

    small = [line for line in TINY if not line.startswith("model.")]
    if lines == ["init_from=other.onnx"]:
        monkeypatch.setattr("mappo_unity.training.launch.adopt_file_options", lambda config, *_: config)
        small += ["model.hidden=[8]"]
    assert train_main([*small, *lines, "output_dir=runs"]) == 2
    err = capsys.readouterr().err
    assert words in err and "Traceback" not in err
    assert not Path("runs").exists()


def test_init_from_does_not_go_with_resume(run: Path, capsys: Any) -> None:
    for option in ("init_from", "behaviors.Probe.init_from"):
        assert train_main([f"resume={run}", f"{option}={run}"]) == 2
        assert f"{option} does not go with resume" in capsys.readouterr().err


def test_a_file_that_was_misread_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "own.onnx"
    path.write_bytes(data_of(make([[4]], 2), [[4]]))
    found = read_network(path)
    found.layers[0].linear.weight[0, 0] += 1.0
    with pytest.raises(ConfigError, match="plays otherwise than the network made of it"):
        started(path, [[4]], 2, [])
    read_network.cache_clear()
