"""Runs that are resumed from an earlier checkpoint, with other options, or before their first one."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from test_self_play import matrix_game
from test_train import BATCH, TINY, options, rows

from mappo_unity import keys
from mappo_unity.cli import train_main
from mappo_unity.config.schema import Backend, CuriosityConfig, EnvConfig, Optimizer, PPOConfig, RewardsConfig
from mappo_unity.learning.carried import CarriedRounds
from mappo_unity.policies.onnx_policy import OnnxPolicy
from mappo_unity.runs import checkpoint
from mappo_unity.runs.folder import NewFolder, create_folder, discard_folder
from mappo_unity.training.run_state import RunState
from mappo_unity.training.saver import CheckpointSaver
from mappo_unity.training.trainer import train


def names(folder: Path) -> list[str]:
    return [path.name for path in checkpoint.checkpoints_in(folder)]


def stop_after(iteration: int) -> Any:
    return lambda state: "interrupted" if state.iteration >= iteration else None


def test_a_run_that_goes_back_keeps_its_new_checkpoints(tmp_path: Path, capsys: Any) -> None:
    cfg = options(6, keep_checkpoints=2, export_onnx=False)
    train(cfg, tmp_path)
    last = names(tmp_path)
    best = tmp_path / "checkpoints" / "best.pt"
    shutil.rmtree(tmp_path / "checkpoints")
    train(replace(cfg, max_steps=2 * BATCH), tmp_path / "other")
    best.parent.mkdir()
    shutil.copy(tmp_path / "other" / "checkpoints" / f"step_{2 * BATCH:012d}.pt", best)
    for name in last:
        shutil.copy(best, best.with_name(name))

    # Only best.pt knows the checkpoint that the run goes back to.
    outcome = train(cfg, tmp_path, best, stop_after(3))
    assert outcome.last_checkpoint is not None and outcome.last_checkpoint.exists()
    assert names(tmp_path) == [f"step_{steps * BATCH:012d}.pt" for steps in (2, 3)]
    assert sorted(path.name for path in (best.parent / "abandoned_1").iterdir()) == last
    assert "2 later checkpoints, up to 720 steps, were moved to" in capsys.readouterr().out
    assert [row["agent_steps"] for row in rows(tmp_path)] == [f"{n * BATCH}" for n in (1, 2, 3)]

    path, _ = checkpoint.newest_good(tmp_path)
    train(cfg, tmp_path, path)
    assert names(tmp_path) == last and not (best.parent / "abandoned_2").exists()


def test_an_interruption_does_not_move_the_rhythm_of_checkpoints(tmp_path: Path) -> None:
    cfg = options(9, keep_checkpoints=20, checkpoint_interval=3 * BATCH, export_onnx=False)
    train(cfg, tmp_path / "whole")
    train(cfg, tmp_path / "parts", after_iteration=stop_after(4))
    path, _ = checkpoint.newest_good(tmp_path / "parts")
    train(cfg, tmp_path / "parts", path)
    assert names(tmp_path / "whole") == [f"step_{n * BATCH:012d}.pt" for n in (1, 3, 6, 9)]
    assert names(tmp_path / "parts") == [f"step_{n * BATCH:012d}.pt" for n in (1, 3, 4, 6, 9)]


def test_a_checkpoint_that_an_error_made_late_keeps_the_rhythm(tmp_path: Path, monkeypatch: Any) -> None:
    cfg = options(9, keep_checkpoints=20, checkpoint_interval=3 * BATCH, export_onnx=False)

    def fail(saver: CheckpointSaver, won: bool) -> None:
        if saver._state.iteration == 3:
            raise RuntimeError("between the iteration and its checkpoint")
        save_if_due(saver, won)

    save_if_due = CheckpointSaver.save_if_due
    with monkeypatch.context() as patch, pytest.raises(RuntimeError):
        patch.setattr(CheckpointSaver, "save_if_due", fail)
        train(cfg, tmp_path)
    path, _ = checkpoint.newest_good(tmp_path)
    train(cfg, tmp_path, path)
    assert names(tmp_path) == [f"step_{n * BATCH:012d}.pt" for n in (1, 3, 6, 9)]


def test_decisions_that_are_pending_do_not_outlive_another_ratio() -> None:
    zeros, ones = torch.zeros(4, 2, 1), torch.ones(4, 2, 1, dtype=torch.bool)
    flags = dict.fromkeys((keys.ACTING, keys.DEPARTED), ones)
    ends = dict.fromkeys((keys.TERMINATED, keys.TRUNCATED), ~ones)
    rewards = dict.fromkeys((keys.REWARD, keys.GROUP_REWARD), zeros)
    following = TensorDict({**rewards, **ends}, (4, 2))
    batch = TensorDict({keys.LOG_PROB: zeros, keys.LOG_PROBS: zeros, **flags, "next": following}, (4, 2))

    joint = CarriedRounds([keys.LOG_PROB])
    joint.rounds = joint.join(batch)[:1]  # pending
    assert len(joint.join(batch)) == 5

    component = CarriedRounds([keys.LOG_PROB, keys.LOG_PROBS])
    component.rounds = joint.rounds
    assert len(component.join(batch)) == 4


def test_the_best_one_of_a_way_that_is_not_taken_is_no_longer_the_best(tmp_path: Path, capsys: Any) -> None:
    cfg = options(6, keep_checkpoints=20, export_onnx=False)
    train(cfg, tmp_path)
    folder = tmp_path / "checkpoints"
    (folder / "best.pt").unlink()
    shutil.copy(folder / names(tmp_path)[-1], folder / "best.pt")
    (folder / "best.onnx").write_text("of the best")
    early = folder / names(tmp_path)[1]

    outcome = train(cfg, tmp_path, early, lambda state: "interrupted")
    assert "the best one until now is of later steps, too, and lies in" in capsys.readouterr().out
    aside = folder / "abandoned_1"
    assert checkpoint.load(aside / "best.pt")["agent_steps"] == 6 * BATCH
    assert (aside / "best.onnx").read_text() == "of the best"
    assert outcome.best_checkpoint is not None
    assert checkpoint.load(outcome.best_checkpoint)["agent_steps"] <= 3 * BATCH

    # one that cannot be read is none
    (folder / "best.pt").unlink()
    (folder / "best.pt").write_bytes(b"cut off")
    path, _ = checkpoint.newest_good(tmp_path)
    train(cfg, tmp_path, path, lambda state: "interrupted")
    assert checkpoint.load(folder / "best.pt")["agent_steps"] <= 4 * BATCH


def test_the_best_checkpoint_keeps_its_opponents(tmp_path: Path) -> None:
    cfg = matrix_game(9, keep_checkpoints=1)
    cfg = replace(cfg, self_play=replace(cfg.self_play, window=1, play_against_latest_model_ratio=0.0))
    folder = tmp_path / "checkpoints"

    def best_is_the_second(state: Any) -> None:
        state.is_best = lambda: state.iteration == 2

    train(cfg, tmp_path, after_iteration=best_is_the_second)
    assert checkpoint.load(folder / "best.pt")["iteration"] == 2
    assert len(list((tmp_path / "pool").iterdir())) < 9
    train(cfg, tmp_path, folder / "best.pt", stop_after(3))


@pytest.mark.parametrize("before", [{"mass": 2.0}, {}])
def test_a_number_that_changes_with_resume_takes_effect(tmp_path: Path, before: dict[str, Any]) -> None:
    cfg = options(3, env=EnvConfig(num_areas=6, params=before), export_onnx=False)
    train(cfg, tmp_path, after_iteration=stop_after(1))
    cfg.env.params = {"mass": 5.0}
    scenes: list[Any] = []
    for iteration in (2, 3):  # the second time nothing changes any more
        path, _ = checkpoint.newest_good(tmp_path)
        train(cfg, tmp_path, path, lambda s: scenes.append(s.setup.env.base_env) or "interrupted")
        assert scenes[-1].parameters["mass"] == 5.0
        assert len(rows(tmp_path)) == iteration


@pytest.mark.parametrize("before", [{"num_threads": 2}, {}])
def test_a_scene_gets_other_threads_with_resume(tmp_path: Path, before: dict[str, Any]) -> None:
    cfg = options(3, env=EnvConfig(num_areas=6, params=before), export_onnx=False)
    train(cfg, tmp_path, after_iteration=stop_after(1))
    cfg.env.params = {"num_threads": 3, "mass": 5.0}
    path, _ = checkpoint.newest_good(tmp_path)
    scenes: list[Any] = []
    train(cfg, tmp_path, path, lambda s: scenes.append(s.setup.env.base_env) or "interrupted")
    assert scenes[0].num_threads == 3 and scenes[0].parameters["mass"] == 5.0


def test_options_of_learning_that_change_with_resume_take_effect(tmp_path: Path) -> None:
    ppo = PPOConfig(minibatch_size=60, lr=0.05, lr_target_kl=1e-4)
    rewards = RewardsConfig(curiosity=CuriosityConfig(strength=0.1))
    cfg = options(4, ppo=ppo, rewards=rewards, export_onnx=False)
    train(cfg, tmp_path, after_iteration=stop_after(2))
    assert float(rows(tmp_path)[-1]["lr"]) < 0.04  # steered down

    seen: list[Any] = []

    def look(state: Any) -> str:
        (learner,) = state.setup.learners.values()
        seen.append((learner.optimizer, learner.rewards.intrinsic[0].optimizer))
        return "interrupted"

    changes = {"lr_target_kl": None, "weight_decay": 0.1, "optimizer_eps": 1e-3, "lr": 1e-3}
    cfg = replace(cfg, ppo=replace(ppo, optimizer=Optimizer.adamw, **changes))
    cfg = replace(cfg, rewards=RewardsConfig(curiosity=replace(rewards.curiosity, lr=1e-2)))
    path, _ = checkpoint.newest_good(tmp_path)
    train(cfg, tmp_path, path, look)

    ((own, curious),) = seen
    assert {(group["weight_decay"], group["eps"]) for group in own.param_groups} == {(0.1, 1e-3)}
    assert own.param_groups[0]["lr"] == float(rows(tmp_path)[-1]["lr"]) <= 1e-3
    assert curious.param_groups[0]["lr"] == 1e-2
    assert own.state  # its moments went on


def test_the_best_policy_is_exported_after_a_resume_if_its_file_is_behind(
    tmp_path: Path, monkeypatch: Any
) -> None:
    cfg = options(4)
    train(cfg, tmp_path, after_iteration=stop_after(2))
    folder = tmp_path / "checkpoints"
    shutil.copy(folder / "final.onnx", folder / "old.onnx")
    train(cfg, tmp_path, checkpoint.newest_good(tmp_path)[0], stop_after(3))
    shutil.copy(folder / "old.onnx", folder / "best.onnx")

    monkeypatch.setattr(RunState, "is_best", lambda state: False)
    train(cfg, tmp_path, checkpoint.newest_good(tmp_path)[0])
    best = checkpoint.load(folder / "best.pt")["agent_steps"]
    assert OnnxPolicy(folder / "best.onnx", False, 0).agent_steps == best == 3 * BATCH


@pytest.mark.parametrize("how", ["interrupted", "killed"])
def test_a_run_without_an_iteration_can_be_started_again(
    tmp_path: Path, capsys: Any, monkeypatch: Any, how: str
) -> None:
    from mappo_unity.training.setup import TrainingSetup

    folder = tmp_path / "run"
    lines = [*TINY, f"max_steps={BATCH}", "log.loggers=[tensorboard]", "export_onnx=false"]
    lines.append(f"hydra.run.dir={folder}")
    if how == "killed":  # its folder stays as it is
        monkeypatch.setattr("mappo_unity.runs.folder.discard_folder", lambda *arguments: None)

    def interrupt(*arguments: Any, **options: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(TrainingSetup, "learn", interrupt)
        assert train_main(lines) != 0
    assert (folder / "metrics.csv").exists() == (how == "killed")

    assert train_main(lines) == 0, capsys.readouterr().err
    assert len(rows(folder)) == 1
    assert train_main(lines) == 2 and "is not empty" in capsys.readouterr().err


def test_only_folders_of_runs_are_cleared(tmp_path: Path) -> None:
    from mappo_unity.errors import ConfigError
    from mappo_unity.runs.lock import locked

    for name in ("config.yaml", "overrides.yaml", "versions.json"):
        with pytest.raises(ConfigError, match="is not empty") if any(tmp_path.iterdir()) else _nothing():
            create_folder(tmp_path, exact=True)
        (tmp_path / name).touch()

    with locked(tmp_path), pytest.raises(ConfigError, match="is being trained by another process"):
        create_folder(tmp_path, exact=True)
    (tmp_path / "notes.txt").touch()
    with pytest.raises(ConfigError, match="is not empty"):
        create_folder(tmp_path, exact=True)
    discard_folder(NewFolder(tmp_path))
    assert (tmp_path / "notes.txt").exists()


def test_self_play_that_begins_with_resume_counts_from_there(tmp_path: Path) -> None:
    cfg = matrix_game(8)
    without = replace(cfg, self_play=replace(cfg.self_play, save_steps=None))
    train(without, tmp_path, after_iteration=stop_after(3))
    begun = int(rows(tmp_path)[-1]["agent_steps"])

    with_pool = replace(cfg, self_play=replace(cfg.self_play, save_steps=100, team_change=100))
    sides: list[int] = []
    train(
        with_pool,
        tmp_path,
        checkpoint.newest_good(tmp_path)[0],
        lambda state: sides.append(state.self_play.state_dict()["learning"]),
    )
    steps = sorted(checkpoint.step_of(path) for path in (tmp_path / "pool").iterdir())
    assert steps[0] == begun and all(later - step >= 100 for step, later in zip(steps, steps[1:]))
    assert sides[0] == 0  # it learns for 100 steps first


def test_without_snapshots_nothing_pending_is_carried_over_and_agents_may_be_more(
    tmp_path: Path, monkeypatch: Any
) -> None:
    from mappo_unity.training.setup import TrainingSetup

    env = EnvConfig(name="Two", backend=Backend.custom, factory="taking_turns:make", params={"num_agents": 4})
    cfg = options(3, env=env, export_onnx=False)
    carried: list[Any] = []
    learn = TrainingSetup.learn

    def look(setup: Any, *arguments: Any, **options: Any) -> Any:
        carried.extend(learner.carried.rounds for learner in setup.learners.values())
        return learn(setup, *arguments, **options)

    monkeypatch.setattr(TrainingSetup, "learn", look)
    train(cfg, tmp_path, after_iteration=stop_after(2))
    assert carried[0] is None and carried[1] is not None  # they ask at their own pace
    cfg.env.params = {"num_agents": 6}
    train(cfg, tmp_path, checkpoint.newest_good(tmp_path)[0], stop_after(3))
    assert carried[2] is None


def _nothing() -> Any:
    from contextlib import nullcontext

    return nullcontext()
