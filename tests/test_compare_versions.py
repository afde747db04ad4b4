"""scripts/compare_versions.py: what was trained is not trained again; what has no score, not at all."""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "scripts"))

import compare_versions

from mappo_unity.errors import ConfigError


def test_a_training_outlasts_an_evaluation_that_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, trained = tmp_path / "out" / "Basic-now-0", []

    def train(command: list[Any], **given: Any) -> None:
        trained.append(command)
        (folder / "checkpoints").mkdir(parents=True)
        for side in ("Goalie", "Striker"):
            (folder / "checkpoints" / f"final_{side}.onnx").touch()

    said: list[Any] = [{"wins": 3}, {"mean_return": 0.5, "stderr": 0.25}]
    monkeypatch.setattr(subprocess, "run", train)
    monkeypatch.setattr(compare_versions, "mappo_eval", lambda *words: said.pop(0))
    arguments = argparse.Namespace(steps=1000, episodes=20)

    with pytest.raises(KeyError, match="mean_return"):
        compare_versions.run("Basic", 0, arguments, tmp_path, folder)
    row = compare_versions.run("Basic", 0, arguments, tmp_path, folder)
    assert len(trained) == 1
    assert list(row)[:5] == ["scene", "seed", "decisions", "seconds", "cpu_seconds"]
    assert (row["decisions"], row["score"], row["folder"]) == (1000, 0.5, str(folder))

    said.append({"mean_return": 0.75, "stderr": 0.25})
    arguments.steps = 2000  # another training
    assert compare_versions.run("Basic", 0, arguments, tmp_path, folder)["score"] == 0.75
    assert len(trained) == 2 and "max_steps=2000" in trained[1]


def test_a_scene_of_several_behaviors_is_refused_unless_they_play_each_other() -> None:
    for scene in ("Basic", "StrikersVsGoalie"):
        compare_versions.check_score(scene)
    with pytest.raises(ConfigError, match="WallJump has no score .* BigWallJump and SmallWallJump earn"):
        compare_versions.check_score("WallJump")
