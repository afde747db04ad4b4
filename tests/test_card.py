"""Model cards: what they say is what was trained and measured, and nobody's own text is overwritten."""

import csv
import math
import shlex
import sys
from dataclasses import replace

import pytest
import yaml

from mappo_unity.cli import export_main, train_main
from mappo_unity.config.compose import compose_config
from mappo_unity.config.schema import CollectConfig, Config, EnvConfig, LogConfig, ModelConfig, PPOConfig
from mappo_unity.policies.evaluate import evaluate
from mappo_unity.runs.folder import write_record
from mappo_unity.sharing import facts
from mappo_unity.sharing.card import Earned, Facts, LastWindow, Won, card_text, is_ours, merged, split
from mappo_unity.sharing.train_line import train_line
from mappo_unity.training.trainer import train

KNOWN = Facts("Ball", "Ball.onnx", "3DBall", 5000, [("a|b", [8])], 2, "branches of 3, 2")


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Return the folder of a run of a few iterations, with what mappo-train leaves in it."""
    folder = tmp_path_factory.mktemp("run")
    cfg = Config(
        env=EnvConfig(num_areas=4),
        model=ModelConfig(hidden=[16]),
        ppo=PPOConfig(minibatch_size=32),
        collect=CollectConfig(rounds=64),
        log=LogConfig(progress=False),
        max_steps=1024,
        export_onnx=False,
    )
    write_record(folder, cfg, [])
    train(cfg, folder)
    return folder


def front_of(path):
    text = path.read_text()
    return yaml.safe_load(text.split("---\n")[1]), text


def test_a_card_tells_how_the_policy_was_trained(run, tmp_path, capsys):
    assert export_main([f"run={run}/checkpoints/step_000000001024.pt", f"out={tmp_path}/x.onnx"]) == 0
    front, text = front_of(tmp_path / "x.md")
    assert front["library_name"] == "mappo-unity" and front["pipeline_tag"] == "reinforcement-learning"
    assert "3DBall" in front["tags"] and "model-index" not in front  # nothing was measured

    with (run / "metrics.csv").open() as file:
        (last,) = [row for row in csv.DictReader(file) if row["agent_steps"] == "1024"]
    assert (
        f"Not evaluated: the mean return of its last training episodes was {float(last['return_mean']):.4g}"
        in text
    )
    assert (
        "1,024" in text and "| sees | `VectorSensor_size8` | [8] |" in text and "2, each from -1 to 1" in text
    )
    assert "3DBall, backend embedded, 4 areas" in text and "mappo-eval run=x.onnx env=3DBall" in text
    assert f"{tmp_path}/x.md: the card" in capsys.readouterr().out


def test_the_score_is_what_mappo_eval_measures(run, tmp_path):
    assert export_main([f"run={run}", f"out={tmp_path}", "episodes=12"]) == 0
    front, text = front_of(tmp_path / "3DBall.md")
    measured = evaluate(run, 12)
    mean, error = measured["mean_return"], measured["stderr"]
    (result,) = front["model-index"][0]["results"]
    assert result["metrics"][0]["value"] == f"{mean:.4g} +/- {error:.2g}"
    assert f"95 % interval {mean - 1.96 * error:.4g} to {mean + 1.96 * error:.4g}" in text


def test_a_checkpoint_without_its_run_has_a_card(run, tmp_path):
    alone = tmp_path / "mine.pt"
    alone.write_bytes((run / "checkpoints" / "best.pt").read_bytes())
    assert export_main([f"run={alone}", "episodes=2"]) == 0
    text = (tmp_path / "mine.md").read_text()
    assert "## Training" not in text and "of 2 episodes" in text


def test_agents_that_request_late_are_measured(tmp_path):
    lines = ["env=custom", "env.name=Late", "env.factory=late_env:make", "model.hidden=[8]", "ppo.epochs=1"]
    lines += ["collect.rounds=8", "max_steps=32", "log.progress=false", "ppo.minibatch_size=16"]
    assert train_main([*lines, "export_onnx=false", f"hydra.run.dir={tmp_path / 'run'}"]) == 0
    assert export_main([f"run={tmp_path / 'run'}", f"out={tmp_path / 'out'}/", "episodes=4"]) == 0
    text = (tmp_path / "out" / "Probe.md").read_text()
    assert "of 4 episodes of an agent" in text and "| sees | `vector` | [1] |" in text


def test_a_text_of_the_users_own_stays(run, tmp_path, capsys):
    card = tmp_path / "x.md"
    card.write_text("mine")
    assert export_main([f"run={run}", f"out={tmp_path}/x.onnx"]) == 0
    assert card.read_text() == "mine" and "stays as it is" in capsys.readouterr().out

    card.unlink()
    assert export_main([f"run={run}", f"out={tmp_path}/x.onnx"]) == 0
    first = card.read_text()
    assert is_ours(first)
    card.write_text(first + "old")
    assert export_main([f"run={run}", f"out={tmp_path}/x.onnx"]) == 0
    assert card.read_text() == first
    assert not list(tmp_path.glob(".*"))  # no temporary files


def test_no_card_is_written_that_nobody_wants(run, tmp_path, capsys):
    assert export_main([f"run={run}", f"out={tmp_path}/x.onnx", "card=false"]) == 0
    assert [path.name for path in tmp_path.iterdir()] == ["x.onnx"]
    for line in ("episodes=3", "video=true"):
        assert export_main([f"run={run}", f"out={tmp_path}/y.onnx", "card=false", line]) == 2
        assert "card=false takes away" in capsys.readouterr().err
    assert export_main([f"run={run}", "episodes=0"]) == 2
    assert not (tmp_path / "y.onnx").exists()


def test_a_film_is_linked(run, tmp_path, monkeypatch):
    pytest.importorskip("imageio_ffmpeg")
    monkeypatch.setattr(facts, "FILM_S", 0.2)
    assert export_main([f"run={run}", f"out={tmp_path}/x.onnx", "video=true"]) == 0
    assert (tmp_path / "x.mp4").stat().st_size > 1000
    assert "[Film](x.mp4)" in (tmp_path / "x.md").read_text()


def test_a_film_that_cannot_be_made_is_told_before_anything_is_written(run, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    assert export_main([f"run={run}", f"out={tmp_path}/new/x.onnx", "video=true"]) == 2
    assert "needs the package imageio_ffmpeg" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "lines",
    [
        ["env=3DBall"],
        ["env=SoccerTwos", "seed=3", "self_play.save_steps=1000", "env.params.ball_touch=0.3"],
        ["env=3DBall", "model.hidden=[32,16]", "ppo.lr_schedule=constant", "ppo.target_kl=0.02"],
        ["env=WallJump", "behaviors.BigWallJump.ppo.lr=1e-4", "behaviors.BigWallJump.model.hidden=[8]"],
        ["env=3DBall", "recipe=mappo_paper", "env.params.mass={uniform: [1, 3]}"],
        ["env=unity", "env.file_name='my builds/a, game'"],
        ["env=unity", "env.backend=editor", "env.port=6000"],
        ["env=SoccerTwos", "env.backend=player", "env.file_name=builds/Soccer", "env.num_players=2"],
        ["env=custom", "env.factory=some.module:make", "env.params.size=3"],
    ],
    ids=lambda lines: " ".join(lines),
)
def test_the_line_in_a_card_trains_the_same(lines):
    config = compose_config(lines).config
    command, *words = shlex.split(train_line(config))
    assert command == "mappo-train" and words[0] == lines[0]
    assert compose_config(words).config == config


def test_the_line_of_a_preset_has_no_options():
    config = compose_config(["env=Basic", "output_dir=/somewhere/else", "log.progress=false"]).config
    assert train_line(config) == "mappo-train env=Basic"


def test_matches_have_their_share_and_interval():
    won = Won(0.75, 0.505, 0.898, wins=12, draws=4, losses=4)
    text = card_text(replace(KNOWN, score=won))
    assert "Won 75.0 % of the decided matches" in text and "50.5 % to 89.8 %" in text
    assert "12 won, 4 drawn, 4 lost" in text
    assert split(text)[0]["model-index"][0]["results"][0]["metrics"][0]["value"] == 0.75

    drawn = card_text(replace(KNOWN, score=Won(math.nan, math.nan, math.nan, 0, 7, 0)))
    assert "7 drawn" in drawn and "nan" not in drawn and "model-index" not in drawn


def test_one_episode_has_no_error_and_undecided_matches_no_share():
    one = card_text(replace(KNOWN, score=Earned(7.0, math.nan, 1)))
    assert "Return 7 in one episode" in one and "nan" not in one

    last = card_text(replace(KNOWN, score=LastWindow(0.0, 1.0, 0.984)))
    assert "it won 100.0 % of the decided ones, 98.4 % of all drawn" in last
    assert "it decided none" in card_text(replace(KNOWN, score=LastWindow(0.0, math.nan, 1.0)))


def test_names_break_no_link():
    assert "[Film](Red%20crew%20%281%29.mp4): the" in card_text(replace(KNOWN, film="Red crew (1).mp4"))


def test_names_break_no_table():
    assert "| sees | `a\\|b` | [8] |" in card_text(KNOWN)


def test_several_cards_become_one():
    first = card_text(replace(KNOWN, score=Earned(1.0, 0.1, 10)))
    second = card_text(replace(KNOWN, policy="Wall", env="WallJump", score=Earned(2.0, 0.1, 10)))
    front, body = split(merged([first, second]))
    assert [entry["name"] for entry in front["model-index"]] == ["Ball", "Wall"]
    assert {"3DBall", "WallJump"} <= set(front["tags"]) and len(front["tags"]) == len(set(front["tags"]))
    assert body.count("\n# ") == 2 and "---" not in body.replace("|---", "")
    assert merged([first]) == first


@pytest.mark.parametrize("text", ["", "mine", "---\nno end", "---\n[broken\n---\nx", "---\n- a list\n---\nx"])
def test_a_text_without_front_matter_is_all_text(text):
    assert split(text) == ({}, text)
