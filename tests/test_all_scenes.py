"""What must hold for every embedded scene: contract, preset, training, resume, episodes, ranges."""

from __future__ import annotations

import importlib
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from test_train import assert_same, rows, without_times

from mappo_unity.config.compose import compose_config
from mappo_unity.config.schema import Config
from mappo_unity.errors import ConfigError
from mappo_unity.policies.episodes import summarize
from mappo_unity.policies.evaluate import play
from mappo_unity.policies.policy import RandomPolicy
from mappo_unity.runs import checkpoint
from mappo_unity.scenes import make_scene
from mappo_unity.scenes.contract.check import check_env
from mappo_unity.scenes.registry import BUILT_IN
from mappo_unity.training.run_state import RunState
from mappo_unity.training.trainer import Outcome, train

ROOT = Path(__file__).resolve().parents[1]
AREAS = 2
TINY = [
    f"env.num_areas={AREAS}",
    "collect.rounds=4",
    "model.hidden=[8]",
    "ppo.epochs=1",
    "ppo.num_minibatches=2",
    "log.loggers=[]",
    "log.progress=false",
    "matches.interval=null",
    "export_onnx=false",
    "checkpoint_interval=1",
    "max_steps=1000000",
]

every_scene = pytest.mark.parametrize("name", BUILT_IN)


@every_scene
def test_contract(name: str) -> None:
    def make() -> Any:
        return make_scene(name, num_areas=AREAS, seed=5)

    report = check_env(make(), steps=120, seed=5, remake=make)
    assert report.checks == ["specs", "records", "errors", "reset", "get_state/set_state", "seed"]
    assert report.decisions > 0


@every_scene
def test_preset_composes_and_makes_the_scene(name: str) -> None:
    config = compose_config([f"env={name}"]).config
    assert config.env.name == name
    assert config.env.num_areas is not None, "a preset states its areas"


@every_scene
def test_page_and_picture_are_in_the_index(name: str) -> None:
    folder = ROOT / "docs" / "scenes"
    index = (folder / "README.md").read_text(encoding="utf-8")
    assert f"[{name}]({name}.md)" in index and f"({name}.png)" in index
    assert (folder / f"{name}.md").is_file() and (folder / f"{name}.png").is_file()


@every_scene
def test_unknown_and_bad_parameters_are_refused(name: str) -> None:
    with pytest.raises(ConfigError, match=f"scene {name} has no parameter 'gravty'; choices: "):
        make_scene(name, gravty=1.0)
    with pytest.raises(ConfigError, match="num_areas=0 must be a whole number >= 1"):
        make_scene(name, num_areas=0)


# ---- training ----------------------------------------------------------------------------------------


def run_until(config: Config, folder: Path, iteration: int, resume_from: Path | None = None) -> Outcome:
    """Train up to an iteration and stop as a signal would; the schedules look at max_steps, not at this."""

    def stop(state: RunState) -> str | None:
        return "interrupted" if state.iteration == iteration else None

    return train(config, folder, resume_from, after_iteration=stop)


@every_scene
def test_two_iterations_are_one_saved_and_one_more_to_the_bit(name: str, tmp_path: Path) -> None:
    config = compose_config([f"env={name}", *TINY]).config
    whole = run_until(config, tmp_path / "whole", 2)
    first = run_until(config, tmp_path / "parts", 1)
    second = run_until(config, tmp_path / "parts", 2, first.last_checkpoint)
    assert whole.agent_steps == second.agent_steps > first.agent_steps > 0
    assert len(rows(tmp_path / "whole")) == 2
    assert rows(tmp_path / "whole") == rows(tmp_path / "parts")
    one, two, once = (loaded(outcome) for outcome in (whole, second, first))
    assert_same(without_times(one), without_times(two))
    assert learned(once, one), "the second iteration changed nothing"


def loaded(outcome: Outcome) -> dict[str, Any]:
    assert outcome.last_checkpoint is not None
    return checkpoint.load(outcome.last_checkpoint)


def learned(before: dict[str, Any], after: dict[str, Any]) -> bool:
    """Return whether every policy's weights differ between two checkpoints."""
    for name in after["learners"]:
        try:
            assert_same(before["learners"][name], after["learners"][name])
        except AssertionError:
            continue
        return False
    return True


# ---- playing -----------------------------------------------------------------------------------------

PLAYED = {  # episodes, areas, and the mean return and decisions that a random policy must come close to
    # a walk with steps -1, 0, 1 from 10 ends at 17 with chance 3/10, after 3 * 7 / (2/3) steps
    "Basic": (400, 16, (0.7 * 0.1 + 0.3 * 1.0 - 0.315, 0.1), (31.5, 6.5)),
    # the next three: as an independent re-implementation of the scenes measured it
    "3DBall": (150, 12, (1.0, 0.3), (20.0, 4.0)),  # 0.1 a decision, -1 at the fall
    "Hallway": (8, 8, (-0.99, 0.3), (495.0, 80.0)),
    "WallJump": (40, 24, (-1.1, 0.25), (46.0, 35.0)),
    "Walker": (10, 4, (-1.0, 1.0), (12.0, 12.0)),  # -1 for the fall, within two seconds; else 0 to 5
}


@pytest.mark.parametrize("name", PLAYED)
def test_random_play_ends_episodes(name: str) -> None:
    episodes, areas, returns, decisions = PLAYED[name]
    env = make_scene(name, num_areas=areas, seed=1)
    for behavior, ended in play(env, RandomPolicy(2), episodes).items():
        figures = summarize(ended)
        assert figures["mean_return"] == pytest.approx(returns[0], abs=returns[1]), behavior
        assert figures["mean_decisions"] == pytest.approx(decisions[0], abs=decisions[1]), behavior
        if name != "Hallway":
            assert figures["interrupted"] < 0.1


# ---- ranges ------------------------------------------------------------------------------------------


@pytest.fixture
def soaking(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """Give scripts/soak_scenes.py as a module; memory may grow, since seconds are no warm-up."""
    monkeypatch.syspath_prepend(str(ROOT / "scripts"))
    module = importlib.import_module("soak_scenes")
    monkeypatch.setattr(module, "MAX_GROWTH", np.inf)
    return module


def faults(report: Any) -> str:
    return "\n".join(f"{rule}: {case}" for rule, case in report.faults.items())


@every_scene
def test_resets_and_bodies_stay_in_their_ranges(name: str, soaking: ModuleType) -> None:
    report = soaking.soak(name, hours=0.003, num_areas=AREAS)
    assert not report.faults, faults(report)
    assert report.resets >= AREAS and report.decisions > 0
    assert report.ticks * soaking.TICK_S.get(name, 0.02) == pytest.approx(10.8, rel=0.02)


def test_soaking_finds_what_is_wrong(soaking: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    from mappo_unity.scenes.hallway.scene import Hallway

    begin, observe = Hallway.begin_episode, Hallway.observe

    def begin_too_far(self: Hallway, slots: np.ndarray) -> None:
        begin(self, slots)
        self.position[slots, 2] += 5.0

    def observe_nothing(self: Hallway, behavior: int, slots: np.ndarray) -> list[np.ndarray]:
        frames = observe(self, behavior, slots)
        frames[1][:] = np.nan
        return frames

    with monkeypatch.context() as patch:
        patch.setattr(Hallway, "begin_episode", begin_too_far)
        assert "begin: agent z not in -20 .. -10" in faults(soaking.soak("Hallway", 0.001, 8))
    with monkeypatch.context() as patch:
        patch.setattr(Hallway, "observe", observe_nothing)
        assert "observations and rewards of Hallway?team=0 are finite" in faults(
            soaking.soak("Hallway", 0.0005, 2)
        )
    with monkeypatch.context() as patch:
        patch.setattr("mappo_unity.scenes.hallway.scene.RUN_SPEED", 90.0)
        patch.setattr("mappo_unity.scenes.hallway.scene.DRIVE", np.array([90.0, 90.0, 90.0, 90.0, 90.0]))
        patch.setattr("mappo_unity.scenes.hallway.scene.Hallway._stop_at_walls", lambda self: None)
        assert "reach beyond the end walls" in faults(soaking.soak("Hallway", 0.002, 2))


def test_soaking_counts_warnings_of_the_engine(
    soaking: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    from mappo_unity.scenes.ball3d.scene import Ball3D

    monkeypatch.chdir(tmp_path)  # MuJoCo keeps a log where it runs
    simulate = Ball3D.simulate

    def burst(self: Ball3D) -> None:
        self.ball_velocity[0, 0] = 1e11
        simulate(self)

    monkeypatch.setattr(Ball3D, "simulate", burst)
    report = soaking.soak("3DBall", 0.0005, 2)
    assert report.warnings > 0
    assert "Nan, Inf or huge value in Q" in faults(report) and "unstable" in faults(report)
