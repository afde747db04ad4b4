"""The tables of scripts/compare_critics.py: what stands on the scenes' pages is what was trained."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "scripts"))

import compare_critics
from decisions_to import settled, with_value
from learn_scene import append

from mappo_unity.config.compose import compose_config
from mappo_unity.learning.rewards.streams import RewardStreams
from mappo_unity.runs.folder import write_record


def test_the_tables_of_the_pages_are_those_of_the_trained_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pages, trained = compare_critics.PAGES, compare_critics.read_curves()
    if not trained:
        pytest.skip("no critics have been trained yet: there is no docs/benchmarks/critics.csv")
    monkeypatch.setattr(compare_critics, "PAGES", tmp_path)
    for scene, curves in trained.items():
        written = (pages / f"{scene}.md").read_text(encoding="utf-8")
        (tmp_path / f"{scene}.md").write_text(written)
        compare_critics.write_page(scene, curves, compare_critics.read_played())
        again = (tmp_path / f"{scene}.md").read_text()
        assert again == written, "python scripts/compare_critics.py --draw writes it anew"


@pytest.mark.parametrize("scene", compare_critics.SCENES)
@pytest.mark.parametrize("critic", compare_critics.CRITICS)
def test_every_critic_is_trained_by_the_presets_schedule(scene: str, critic: str) -> None:
    preset = compose_config([f"env={scene}"]).config
    half = preset.max_steps // 2
    config = compose_config([f"env={scene}", *compare_critics.options(scene, critic, half)]).config
    assert (config.model.critic.value, config.max_steps) == (critic, half)

    middle = (preset.ppo.entropy_coef + preset.ppo.entropy_coef_final) / 2
    assert config.ppo.entropy_coef_final == pytest.approx(middle)
    assert config.ppo.lr_final == pytest.approx((preset.ppo.lr + preset.ppo.lr_final) / 2)


@pytest.mark.parametrize("share", [0.2, 0.5, 0.75, 1.0])
@pytest.mark.parametrize("part", [(0.4, 0.4), (0.25, 0.625), (0.0, 1.0), (0.2, 1.0)])
def test_the_discount_of_a_shorter_run_moves_as_in_the_beginning(
    share: float, part: tuple[float, float]
) -> None:
    moves = ["ppo.gamma_schedule=linear", "ppo.gamma=0.9", "ppo.gamma_final=0.998"]
    whole = [*moves, *(f"ppo.{name}={value}" for name, value in zip(("gamma_from", "gamma_until"), part))]
    preset = compose_config(whole).config.ppo
    shorter = compose_config([*whole, *compare_critics.discount_options(preset, share)]).config.ppo

    for over in (0.0, 0.1, 0.3, 0.55, 0.79, 0.81, 0.99):
        there, here = RewardStreams(preset), RewardStreams(shorter)
        there.begin(over * share)
        here.begin(over)
        assert here.gammas == pytest.approx(there.gammas, abs=1e-6)


def test_only_a_shorter_run_has_a_discount_of_its_own() -> None:
    def moved(scene: str, steps: int) -> list[str]:
        lines = compare_critics.options(scene, "local", steps)
        return [line for line in lines if line.startswith("ppo.gamma")]

    assert moved("DungeonEscape", 1_000_000) == ["ppo.gamma_from=0.8", "ppo.gamma_until=0.8"]
    assert not moved("DungeonEscape", 2_000_000) and not moved("CooperativePushBlock", 1_000_000)


def test_a_row_has_the_seeds_of_a_critic(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """There is a mean where each seed has been played."""
    end = {
        "scene": "DungeonEscape",
        "critic": "local",
        "seed": 0,
        "decisions": 1_000_000,
        "minutes": 3,
        "value": 0,
        "lesson": 2,
        "lessons": 2,
    }
    rows = [{**end, "decisions": 500_000, "lesson": 1}, end, {**end, "seed": 1, "lesson": 1}]
    rows += [{**end, "critic": "central", "minutes": 2}]
    rows += [{**end, "critic": "poca", "seed": seed} for seed in (0, 1)]
    for row in rows:
        append(tmp_path / "critics.csv", row)
    for critic, seed, value in (("local", 0, 0.3), ("local", 1, 0.5), ("central", 0, 0.6), ("poca", 1, 0.9)):
        played = {"scene": "DungeonEscape", "critic": critic, "seed": seed, "value": value}
        append(tmp_path / "critics_played.csv", played)
    page = tmp_path / "DungeonEscape.md"
    page.write_text(f"before\n{compare_critics.BEGIN}old\n{compare_critics.END}after\n")
    monkeypatch.setattr(compare_critics, "CURVES", tmp_path / "critics.csv")
    monkeypatch.setattr(compare_critics, "PLAYED", tmp_path / "critics_played.csv")
    monkeypatch.setattr(compare_critics, "PAGES", tmp_path)

    [(scene, curves)] = compare_critics.read_curves().items()
    compare_critics.write_page(scene, curves, compare_critics.read_played())
    lines = page.read_text().splitlines()
    assert (lines[0], lines[-1]) == ("before", "after") and "old" not in lines
    rows = [
        "| central (MAPPO) | 0 | 1.0 M | **0.60** (0.60) | 2 of 2 | 2.0 |",
        "| local (IPPO) | 0, 1 | 1.0 M | **0.40** (0.30, 0.50) | 2, 1 of 2 | 3.0 |",
        "| MA-POCA | 0, 1 | 1.0 M | - (-, 0.90) | 2, 2 of 2 | 3.0 |",
    ]
    assert lines[-5:-2] == rows


def test_a_run_that_ends_before_a_hundred_episodes_has_no_curve(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "DungeonEscape-local-0"
    folder.mkdir()
    write_record(folder, compose_config(["env=DungeonEscape"]).config, [])
    header = "agent_steps,wall_s,episodes,group_return_mean\n"
    (folder / "metrics.csv").write_text(f"{header}10,1,40,0.1\n20,2,99,0.2\n")
    monkeypatch.setattr(compare_critics, "CURVES", tmp_path / "critics.csv")
    monkeypatch.setattr(compare_critics, "train", lambda *given: None)
    arguments = argparse.Namespace(out=tmp_path, steps=20, minutes=1.0)

    compare_critics.learn(arguments, "DungeonEscape", "local", 0)
    assert not compare_critics.CURVES.exists()
    assert f"{folder}: no curve" in capsys.readouterr().out

    (folder / "metrics.csv").write_text(f"{header}10,1,40,0.1\n20,2,100,0.2\n")
    compare_critics.learn(arguments, "DungeonEscape", "local", 0)
    [point] = compare_critics.read_curves()["DungeonEscape"]["local"]["0"]
    assert (point.decisions, point.value) == (20, 0.2)


def test_the_checkpoint_at_the_runs_end_is_played_in_the_last_lesson(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a run that went on its later ones are not; what has been played is not played again."""
    folder = tmp_path / "CooperativePushBlock-local-3"
    (folder / "checkpoints").mkdir(parents=True)
    for steps in (900, 1000, 1100):
        (folder / "checkpoints" / f"step_{steps:012d}.pt").touch()
    write_record(folder, compose_config(["env=CooperativePushBlock"]).config, [])
    monkeypatch.setattr(compare_critics, "PLAYED", tmp_path / "critics_played.csv")
    asked = []

    def mappo_eval(*options: str) -> dict[str, float]:
        asked.append(options)
        return {"mean_return": 4.5, "mean_group_return": 9.25, "stderr": 0.125}

    monkeypatch.setattr(compare_critics, "mappo_eval", mappo_eval)
    arguments = argparse.Namespace(out=tmp_path, steps=950)
    for _ in range(2):
        compare_critics.play(arguments, "CooperativePushBlock", "local", 3)

    end = folder / "checkpoints" / "step_000000001000.pt"
    assert asked == [(f"run={end}", "episodes=400", "env.params.gravity=14.715")]
    assert compare_critics.read_played() == {("CooperativePushBlock", "local", "3"): 9.25}


def test_a_scene_without_lessons_has_no_column_of_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "DungeonEscape.md").write_text("")
    monkeypatch.setattr(compare_critics, "PAGES", tmp_path)
    point = compare_critics.Point(1e6, 2.0, 0.6, lesson=1, lessons=1)
    played = {("DungeonEscape", "central", "0"): 0.6}
    compare_critics.write_page("DungeonEscape", {"central": {"0": [point]}}, played)
    page = (tmp_path / "DungeonEscape.md").read_text()
    assert "| central (MAPPO) | 0 | 1.0 M | **0.60** (0.60) | 2.0 |" in page and "lesson" not in page


def test_a_curve_leaves_out_the_first_episodes_of_each_later_lesson() -> None:
    """What ends there first began before, or is short by luck; the first lesson needs its 100 episodes."""
    nan = float("nan")
    values = [(50, 0, 9.0), (150, 0, 1.0), (200, 1, nan), (300, 1, 9.0), (450, 1, 2.0), (500, 2, 9.0)]
    metrics = [{"episodes": e, "lesson/g": n, "group_return_mean": v} for e, n, v in values]
    rows = with_value(settled(metrics, ["lesson/g"]), "group_return_mean")
    assert [row["group_return_mean"] for row in rows] == [1.0, 2.0]


def test_a_scene_without_a_team_is_refused(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["compare_critics.py", "Basic"])
    with pytest.raises(SystemExit) as end:
        compare_critics.main()
    assert end.value.code == 2
    line = capsys.readouterr().err.splitlines()[-1]
    assert "Basic" in line and "DungeonEscape" in line
