"""Exports of checkpoints: the same play, whole files, and never the end of a run."""

import csv
import math
import shutil
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from onnx_fakes import official_policy, run_policy
from tensordict import TensorDict

from mappo_unity.cli import eval_main, export_main, train_main
from mappo_unity.config.compose import compose_config
from mappo_unity.config.extras import install_command
from mappo_unity.config.schema import CollectConfig, Config, EnvConfig, LogConfig, ModelConfig, PPOConfig
from mappo_unity.policies import export
from mappo_unity.policies.evaluate import evaluate
from mappo_unity.policies.export import RunExports, export_checkpoint, sample_inputs
from mappo_unity.policies.onnx_graph import ExportError
from mappo_unity.policies.onnx_policy import OnnxPolicy
from mappo_unity.policies.policy import CheckpointPolicy
from mappo_unity.runs import checkpoint
from mappo_unity.runs.folder import write_record
from mappo_unity.scenes import make_scene
from mappo_unity.training.trainer import train

AREAS, ROUNDS = 4, 16


def options(iterations, **changes):
    cfg = Config(
        env=EnvConfig(num_areas=AREAS),
        model=ModelConfig(hidden=[16]),
        ppo=PPOConfig(minibatch_size=32),
        collect=CollectConfig(rounds=ROUNDS),
        log=LogConfig(loggers=[], progress=False),
        max_steps=iterations * AREAS * ROUNDS,
        checkpoint_interval=AREAS * ROUNDS,
    )
    return replace(cfg, **changes)


@pytest.fixture(scope="module")
def tiny_run(tmp_path_factory):
    """Return the folder of a run of a few iterations, with what mappo-train leaves in it."""
    folder = tmp_path_factory.mktemp("run")
    write_record(folder, options(4), [])
    train(options(4), folder)
    return folder


def first_decisions(rounds=30):
    """Yield decisions of 3DBall under random actions."""
    env = make_scene("3DBall", seed=9, num_areas=AREAS)
    env.reset()
    name = list(env.behavior_specs)[0]
    spec = env.behavior_specs[name]
    for _ in range(rounds):
        decision, _ = env.get_steps(name)
        if len(decision):
            yield name, decision, spec
            env.set_actions(name, spec.action_spec.random_action(len(decision)))
        env.step()
    env.close()


def test_a_run_leaves_its_best_and_its_final_policy(tiny_run):
    folder = tiny_run / "checkpoints"
    final = OnnxPolicy(folder / "final.onnx", deterministic=True)
    assert final.agent_steps == 4 * AREAS * ROUNDS
    assert final.metadata["behavior_name"] == "3DBall" and final.metadata["env_name"] == "3DBall"
    best = OnnxPolicy(folder / "best.onnx", deterministic=True)
    assert best.agent_steps == checkpoint.load(folder / "best.pt")["agent_steps"]
    assert not [p for p in folder.iterdir() if p.suffix not in (".pt", ".onnx")]  # no temporary files


def test_a_run_that_was_broken_off_before_its_last_export_gets_it_by_resuming(tiny_run, tmp_path, capsys):
    run = shutil.copytree(tiny_run, tmp_path / "run")
    final = run / "checkpoints" / "final.onnx"
    written = final.read_bytes()
    assert train_main([f"resume={run}"]) == 0
    assert "nothing to train, and nothing was changed" in capsys.readouterr().out

    for left in (None, b"half a file", (run / "checkpoints" / "best.onnx").read_bytes()[:-1]):
        final.unlink()
        if left is not None:
            final.write_bytes(left)
        assert train_main([f"resume={run}"]) == 0
        said = capsys.readouterr().out
        assert "nothing to train, and its last ONNX files, which were missing, were written: the run" in said
        assert final.read_bytes() == written

    # one that wants no files gets none
    final.unlink()
    assert train_main([f"resume={run}", "export_onnx=false"]) == 0
    assert "nothing was changed" in capsys.readouterr().out and not final.exists()


def test_an_export_plays_the_scene_as_its_checkpoint(tiny_run):
    folder = tiny_run / "checkpoints"
    exported = OnnxPolicy(folder / "best.onnx", deterministic=True)
    original = CheckpointPolicy(folder / "best.pt", deterministic=True)
    seen = 0
    for step in first_decisions():
        a, b = exported.act(*step).continuous, original.act(*step).continuous
        np.testing.assert_allclose(a, b, atol=1e-5)
        seen += len(a)
    assert seen > 50


def test_an_export_plays_in_a_client_that_is_not_ours(shared, tiny_run):
    """run_policy.py knows only the contract; its actions are those of the checkpoint."""
    theirs = official_policy(shared, tiny_run / "checkpoints" / "best.onnx", deterministic=True)
    original = CheckpointPolicy(tiny_run / "checkpoints" / "best.pt", deterministic=True)
    for name, decision, spec in first_decisions():
        expected = original.act(name, decision, spec).continuous
        np.testing.assert_allclose(theirs.act(decision, spec).continuous, expected, atol=1e-5)


def test_a_checkpoint_holds_what_its_policies_acted_on(tiny_run):
    sample = checkpoint.load(tiny_run / "checkpoints" / "best.pt")["samples"]["3DBall"]
    assert sample["observation"].shape == (AREAS * ROUNDS, 8)
    assert (sample["observation"].std(0) > 0).sum() >= 6


def test_samples_are_rows_that_acted():
    acting = torch.zeros(10, 3, 2, 1, dtype=torch.bool)
    acting[3, 1, 0] = acting[7, 2, 1] = True
    obs = torch.arange(10 * 3 * 2 * 4.0).reshape(10, 3, 2, 4)
    few = sample_inputs(TensorDict({"acting": acting, "observation": obs}, [10, 3, 2]), ["observation"])
    assert torch.equal(few["observation"], torch.stack([obs[3, 1, 0], obs[7, 2, 1]]))


def test_of_many_rows_samples_are_spread_over_the_batch():
    obs = torch.arange(50 * 3 * 2.0).reshape(50, 3, 2, 1)
    entries = TensorDict({"acting": torch.ones(50, 3, 2, 1), "observation": obs}, [50, 3, 2])
    rows = sample_inputs(entries, ["observation"])["observation"][:, 0]
    assert len(rows) == 64 and rows[0] == 0 and rows[-1] == 299
    assert rows.diff().min() >= 4 and rows.diff().max() <= 5


def rows(folder):
    times = {"wall_s", "steps_per_s", "collect_s", "update_s"}
    with open(folder / "metrics.csv", newline="") as file:
        return [{k: v for k, v in row.items() if k not in times} for row in csv.DictReader(file)]


def test_exports_change_nothing_in_a_run(tmp_path, tiny_run):
    train(options(4, export_onnx=False), tmp_path)
    assert rows(tmp_path) == rows(tiny_run)
    assert not list(tmp_path.rglob("*.onnx"))


def test_a_failed_export_is_one_line_and_ends_no_run(tmp_path, monkeypatch):
    def fail(path, out=None):
        raise MemoryError("a new\nfailure")

    monkeypatch.setattr(export, "export_checkpoint", fail)
    messages = []
    monkeypatch.setattr("mappo_unity.runs.logger.RunLog.message", lambda self, text: messages.append(text))
    outcome = train(options(3), tmp_path)
    assert outcome.status == "finished" and outcome.agent_steps == 3 * AREAS * ROUNDS
    assert outcome.last_checkpoint is not None and outcome.last_checkpoint.is_file()
    failures = [text for text in messages if not text.startswith("run folder: ")]
    assert len(failures) == 1 and failures[0].endswith("(training continues): a new failure")
    assert not list(tmp_path.rglob("*.onnx"))


def test_the_best_is_exported_at_most_every_ten_seconds_and_at_the_end(tmp_path, monkeypatch):
    now, written = [100.0], []
    monkeypatch.setattr(export.time, "monotonic", lambda: now[0])

    def note(path, out=None):
        written.append((now[0], path.name, out.name if out else None))
        now[0] += 1.0  # a second an export: the next may come after 50

    monkeypatch.setattr(export, "export_checkpoint", note)
    folder = tmp_path / "checkpoints"
    folder.mkdir()
    for name in ("best.pt", "step_000000000064.pt"):
        (folder / name).touch()
    (folder / "best.onnx").touch()
    exports = RunExports(tmp_path, lambda text: None)
    for now[0] in (100.0, 105.0, 112.0, 150.0, 151.5, 160.0):
        exports.best_changed()
    assert [time for time, _, _ in written] == [100.0, 151.5]
    now[0] = 170.0
    exports.finish(folder / "step_000000000064.pt")
    assert [row[1:] for row in written[2:]] == [("best.pt", None), ("step_000000000064.pt", "final.onnx")]
    written.clear()
    exports.finish(None)  # the best is written by now
    assert written == []


def test_the_last_words_of_a_run_with_a_cheap_export_come_every_ten_seconds(tmp_path, monkeypatch):
    now, written = [0.0], []
    monkeypatch.setattr(export.time, "monotonic", lambda: now[0])
    monkeypatch.setattr(export, "export_checkpoint", lambda path, out=None: written.append(now[0]))
    (tmp_path / "checkpoints").mkdir()
    (tmp_path / "checkpoints" / "best.pt").touch()
    exports = RunExports(tmp_path, lambda text: None)
    for now[0] in (0.0, 1.0, 9.9, 10.1, 11.0, 20.2):
        exports.best_changed()
    assert written == [0.0, 10.1, 20.2]


def test_a_file_is_written_whole_or_not_at_all(tiny_run, tmp_path, monkeypatch):
    target = tmp_path / "policy.onnx"
    target.write_bytes(b"old")
    monkeypatch.setattr(
        "mappo_unity.runs.atomic.os.replace", lambda a, b: (_ for _ in ()).throw(OSError(28, "full"))
    )
    with pytest.raises(ExportError, match="cannot be written: full"):
        export_checkpoint(tiny_run / "checkpoints" / "best.pt", target)
    assert target.read_bytes() == b"old"
    assert [p.name for p in tmp_path.iterdir()] == ["policy.onnx"]


def test_several_policies_get_a_file_each(tiny_run, tmp_path):
    state = checkpoint.load(tiny_run / "checkpoints" / "best.pt")
    for key in ("layout", "model", "learners", "samples"):
        state[key] = {"Small": state[key]["3DBall"], "Big/er": state[key]["3DBall"]}
    path = tmp_path / "checkpoints" / "best.pt"
    checkpoint.save(path, {k: v for k, v in state.items() if k != "format"})
    assert [e.path.name for e in export_checkpoint(path)] == ["best_Small.onnx", "best_Big_er.onnx"]
    inside = export_checkpoint(path, tmp_path / "folder")
    assert [e.path for e in inside] == [tmp_path / "folder" / n for n in ("Small.onnx", "Big_er.onnx")]
    assert OnnxPolicy(inside[1].path, True).metadata["behavior_name"] == "Big/er"


@pytest.mark.parametrize("package", ["onnx", "onnxruntime"])
def test_a_missing_package_names_the_extra(monkeypatch, package, tiny_run):
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(ExportError, match=rf"package {package} is needed") as caught:
        export_checkpoint(tiny_run / "checkpoints" / "best.pt", tiny_run / "never.onnx")
    assert install_command("export") in str(caught.value)
    assert not (tiny_run / "never.onnx").exists()


# --- the commands


def test_mappo_export_writes_where_it_is_told(tiny_run, tmp_path, capsys):
    out = tmp_path / "new" / "Ball.onnx"
    assert export_main([f"run={tiny_run}", f"out={out}"]) == 0
    assert str(out) in capsys.readouterr().out
    assert OnnxPolicy(out, False).metadata["behavior_name"] == "3DBall"
    assert export_main([f"run={tiny_run}/checkpoints/best.pt", f"out={tmp_path}"]) == 0
    assert (tmp_path / "3DBall.onnx").is_file()


@pytest.mark.parametrize(
    "line, message",
    [
        ([], "run is not given"),
        (["run=nowhere"], "run=nowhere does not exist"),
        (["run=nowhere", "out="], "out= is empty"),
        (["run=nowhere", "outt=x"], "outt"),
    ],
)
def test_mistakes_of_mappo_export_are_explained(line, message, capsys):
    assert export_main(line) == 2
    assert message in capsys.readouterr().err


def test_a_checkpoint_without_observations_is_refused(tiny_run, tmp_path):
    state = checkpoint.load(tiny_run / "checkpoints" / "best.pt")
    state = {k: v for k, v in state.items() if k not in ("format", "samples")}
    checkpoint.save(tmp_path / "old.pt", state)
    with pytest.raises(ExportError, match="holds no observations of '3DBall'"):
        export_checkpoint(tmp_path / "old.pt")


def test_mappo_eval_plays_an_onnx_file_as_its_checkpoint(tiny_run, tmp_path, capsys):
    """Deterministic, same seed, same scene: every episode is the same, so the figures are."""
    figures = []
    best = tiny_run / "checkpoints" / "best"
    for policy in (f"{best}.pt", f"{best}.onnx"):
        assert eval_main([f"run={policy}", "episodes=8", "deterministic=true", "seed=3"]) == 0
        figures.append(capsys.readouterr().out.splitlines()[-1].partition("agent_steps")[2])
    assert figures[0] == figures[1] and "mean_return" in figures[0]
    elsewhere = tmp_path / "policy.onnx"
    elsewhere.write_bytes((tiny_run / "checkpoints" / "best.onnx").read_bytes())
    assert eval_main([f"run={elsewhere}", "env=3DBall", "episodes=2"]) == 0
    assert '"agent_steps": ' in capsys.readouterr().out
    assert eval_main([f"run={elsewhere}"]) == 2
    assert "env=3DBall (3DBall" in capsys.readouterr().err
    assert eval_main([f"run={best}.pt", "opponent=nowhere"]) == 2
    assert "opponent=nowhere does not exist: give random, zoo, a run folder" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize("deterministic", [False, True])
def test_run_policy_earns_what_mappo_eval_says(shared, tmp_path, deterministic):
    """A half-trained 3DBall policy within four standard errors.

    It earns 6 of 100, and 15 without sampling; a perfect one hides differences, and plays for minutes.

    Two would fail one honest run in ten (four comparisons); the many episodes keep four of them narrow, and
    the share of episodes that run_policy leaves unfinished, the longer ones, small.
    """
    episodes = 800
    lines = ["env=3DBall", "max_steps=32000", "log.loggers=[]", "log.progress=false"]
    cfg = compose_config(lines).config
    write_record(tmp_path, cfg, lines)
    train(cfg, tmp_path)
    path = tmp_path / "checkpoints" / "final.onnx"
    found = evaluate(checkpoint.checkpoints_in(tmp_path)[-1], episodes, deterministic, seed=1)
    played = evaluate(path, episodes, deterministic, seed=2, env="3DBall")
    env = make_scene("3DBall", seed=3)
    policies = {"3DBall": official_policy(shared, path, deterministic)}
    done = run_policy(shared).play(env, policies, episodes, 200_000)["3DBall?team=0"]
    env.close()
    returns = np.array([row[0] for row in done])
    error = returns.std() / len(returns) ** 0.5
    for mean, stderr in ((played["mean_return"], played["stderr"]), (returns.mean(), error)):
        assert abs(mean - found["mean_return"]) <= 4 * math.hypot(stderr, found["stderr"]) + 1e-3
