"""scripts/score_table.py and the scripts that train as it does: what is written of a run, what is resumed."""

from __future__ import annotations

import argparse
import csv
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "scripts"))

import learn_scene
import score_table
from score_measures import Measure, mean_return

from mappo_unity.config.compose import compose_config
from mappo_unity.errors import ConfigError
from mappo_unity.runs.folder import write_record


def test_rows_are_appended_all_or_none(tmp_path: Path) -> None:
    path = tmp_path / "rows.csv"
    learn_scene.append(path)
    assert not path.exists()

    learn_scene.append(path, {"scene": "a, b", "value": 1}, {"scene": "c", "value": 2})
    learn_scene.append(path, {"scene": "d", "value": 3})
    with pytest.raises(ValueError, match="unknown"):
        learn_scene.append(path, {"scene": "e", "value": 4}, {"scene": "f", "unknown": 5})
    assert path.read_bytes() == b'scene,value\r\n"a, b",1\r\nc,2\r\nd,3\r\n'


def test_a_curve_is_written_whole_or_not_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(score_table, "CURVES", tmp_path / "curves.csv")
    measure = Measure("Probe", "return", mean_return, 0.5)
    rows: list[dict[str, Any]] = [
        {"agent_steps": 100 * n, "episodes": 100 * n, "wall_s": 60.0 * n, "return_mean": 0.1 * n}
        for n in (1, 2)
    ]
    broken = {"agent_steps": 300, "episodes": 300, "return_mean": 0.3}  # as good as an interruption there

    with pytest.raises(KeyError):
        score_table.append_curve(measure, 0, [*rows, broken])
    assert not score_table.CURVES.exists(), "what stands there is taken for the whole curve"

    score_table.append_curve(measure, 0, rows)
    score_table.append_curve(measure, 0, rows)
    with open(score_table.CURVES, newline="") as file:
        assert [row["value"] for row in csv.DictReader(file)] == ["0.1", "0.2"]


OPTIONS = ["ppo.lr=1e-4", "env.num_areas=2"]


@pytest.fixture
def begun(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the folder of a run that an interruption cut off, and that was resumed by hand since then."""
    folder = tmp_path / "Hallway-0"
    (folder / "checkpoints").mkdir(parents=True)
    begin = ["env=Hallway", "seed=0", "hydra.run.dir=out/Hallway-0", *OPTIONS]
    for lines in (begin, ["resume=out/Hallway-0", "max_steps=3000000"]):
        write_record(folder, compose_config(["env=Hallway", *OPTIONS]).config, lines)
    (folder / "metrics.csv").write_text("agent_steps,wall_s\n100,6\n")
    monkeypatch.setattr(score_table, "SCORES", tmp_path / "scores.csv")
    return folder


def test_a_run_is_resumed_with_the_options_that_it_was_begun_with(
    begun: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ran: list[list[Any]] = []
    monkeypatch.setattr(subprocess, "run", lambda command, check: ran.append(command))
    learn_scene.train("Hallway", 0, begun, OPTIONS[::-1])
    assert [command[1:] for command in ran] == [[f"resume={begun}"]]

    new = begun.with_name("Hallway-1")
    learn_scene.train("Hallway", 1, new, OPTIONS)
    assert ran[1][1:] == ["env=Hallway", "seed=1", f"hydra.run.dir={new}", *OPTIONS]

    (begun / "overrides.yaml").unlink()  # which then says nothing else
    learn_scene.train("Hallway", 0, begun, [])
    assert ran[2][1:] == [f"resume={begun}"]


@pytest.mark.parametrize("options", [[], ["ppo.lr=1e-3", OPTIONS[1]], [*OPTIONS, "max_steps=3000000"]])
def test_a_run_is_not_resumed_for_other_options(
    options: list[str], begun: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(subprocess, "Popen", lambda *given: pytest.fail("it trains"))
    monkeypatch.setattr(subprocess, "run", lambda *given: pytest.fail("it trains"))
    arguments = argparse.Namespace(out=begun.parent, minutes=1.0, episodes=None, unity=None)
    with pytest.raises(ConfigError, match=r"begun with env=Hallway seed=0 ppo.lr=1e-4 env.num_areas=2"):
        score_table.measure_seed(arguments, "Hallway", 0, options)
    with pytest.raises(ConfigError, match="give the same options or another --out"):
        learn_scene.train("Hallway", 0, begun, options)

    # nor is what else is to be measured of a trained run noted with options that it has not
    score_table.SCORES.write_text("scene,measure,policy,sampled\nHallway,return,0,True\n")
    with pytest.raises(ConfigError, match="begun with"):
        score_table.measure_seed(arguments, "Hallway", 0, options)
