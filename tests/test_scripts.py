"""scripts/: each says what it is for, and a mistake of its user is one line and exit code 2."""

from __future__ import annotations

import argparse
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

from mappo_unity.errors import ConfigError, EnvironmentFailure

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "scripts"))

from run_script import positive, run_script

SCRIPTS = Path(__file__).resolve().parents[1] / "scripts"
COMMANDS = sorted(path.name for path in SCRIPTS.glob("*.py") if "__main__" in path.read_text())
PEER = "--peer mlagents-learn --official ."
NO_COUNT = "0 must be a whole number of at least 1"
NO_SCENE = "there is no embedded scene 'Nope'"

MISTAKES = [
    ("bench_3dball.py --repeats 0", NO_COUNT),
    ("bench_batch_memory.py Nope", "env=Nope does not exist"),
    ("bench_checkouts.py nowhere", "FOLDER=nowhere must be a checkout"),
    (f"bench_checkouts.py {SCRIPTS.parent} --scene Nope", "Nope: there is no such scene"),
    ("bench_device.py --iterations 0", NO_COUNT),
    ("bench_peer.py --scenes Basic", "--peer and --official are needed"),
    (f"bench_peer.py --scenes Nope {PEER}", "Nope: there is no such scene"),
    (f"bench_peer.py --scenes Pyramids {PEER}", "--official=. has no ppo/PyramidsRND.yaml"),
    ("bench_player.py --scene Nope", "there is no scene 'Nope'"),
    ("bench_scaling.py Nope", "env=Nope does not exist"),
    ("bench_scenes.py Nope", NO_SCENE),
    ("bench_scenes.py Basic --repeats 0", NO_COUNT),
    ("bench_self_play.py Nope", "env=Nope does not exist"),
    ("bench_update.py Nope", "env=Nope does not exist"),
    ("bench_video.py --repeats 0", NO_COUNT),
    ("bench_vmas.py --frames 0", NO_COUNT),
    ("check_dungeon.py --policy nowhere", "policy=nowhere does not exist"),
    ("check_dungeon.py --policy random --episodes 0", NO_COUNT),
    ("check_export.py nowhere --run-policy nowhere.py", "run_policy.py is not at nowhere.py"),
    ("check_goalie.py nowhere", "nowhere does not exist"),
    ("check_gradient.py --run nowhere", "run=nowhere does not exist"),
    ("check_gradient.py --run nowhere --decisions 9", "--decisions 9 must be at least four batches of 2560"),
    ("check_install.py --timeout much", "invalid float value: 'much'"),
    ("check_kills.py --scene Nope", "env=Nope does not exist"),
    ("check_mlagents_configs.py nowhere", "nowhere does not exist"),
    ("check_novelty.py --matches 0", NO_COUNT),
    ("check_randomized.py --episodes 0", NO_COUNT),
    ("check_soccer.py --episodes 0", NO_COUNT),
    ("check_walker.py --policy nowhere", "policy=nowhere does not exist"),
    ("check_walker.py --policy random --episodes 0", NO_COUNT),
    ("check_warm_starts.py nowhere", "there is no .onnx file"),
    ("clone_demos.py nowhere", "does not exist"),
    ("compare.py env=Nope default", "env=Nope does not exist"),
    ("compare_critics.py Nope", "Nope: critics are compared in"),
    ("compare_curriculum.py --ways Nope", "invalid choice: 'Nope'"),
    ("compare_signals.py --demos nowhere", "there is no Expert"),
    ("compare_versions.py nowhere", "nowhere must be a checkout"),
    (f"compare_versions.py {SCRIPTS.parent} --scenes WallJump", "WallJump has no score to compare"),
    (f"compare_versions.py {SCRIPTS.parent} --scenes Nope", NO_SCENE),
    ("curve_against.py random nowhere", "nowhere does not exist"),
    ("curve_spread.py nowhere", "run=nowhere does not exist"),
    ("curve_table.py 1e6 nowhere", "nowhere does not exist"),
    ("decisions_to.py 1 nowhere", "nowhere does not exist"),
    ("decisions_to.py much nowhere", "invalid float value: 'much'"),
    ("draw_scenes.py Nope", "Nope: there is no such scene"),
    ("film_zoo.py Nope", "Nope: there is no such scene"),
    ("learn_scene.py Basic --episodes 0", NO_COUNT),
    ("make_zoo.py nowhere", "nowhere/config.yaml cannot be read"),
    ("race_peer.py --scenes Basic=1", "--peer and --official are needed"),
    ("race_peer.py --scenes Basic=1 --patience 0.5", "--patience: 0.5 must be a number of at least 1"),
    ("race_peer.py --scenes StrikersVsGoalie=9", "--scenes: StrikersVsGoalie cannot be raced: no return"),
    ("race_peer.py --scenes Basic", "--scenes: Basic must be SCENE=MINUTES, such as 3DBall=3"),
    ("score_doctor.py nowhere", "nowhere: there is no such fault"),
    ("score_table.py Nope", "Nope: there is no such scene"),
    ("simulate_cluster.py --scene Nope", "env=Nope does not exist"),
    ("soak_player.py --max-steps 0", NO_COUNT),
    ("soak_scenes.py --scenes Nope", "invalid choice: 'Nope'"),
    ("wrap_docs.py nowhere", "nowhere does not exist"),
    ("write_golden.py nowhere", "nowhere: there is no such run"),
]


def run(words: str, monkeypatch: pytest.MonkeyPatch) -> int | str | None:
    """Run a script of scripts/ in this process; return its exit code."""
    name, *arguments = words.split()
    monkeypatch.setattr(sys, "argv", [name, *arguments])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(SCRIPTS / name), run_name="__main__")
    return ended.value.code


@pytest.mark.parametrize("name", COMMANDS)
def test_every_script_says_what_it_is_for(name, monkeypatch, capsys):
    assert run(f"{name} --help", monkeypatch) == 0
    assert "usage:" in capsys.readouterr().out


def test_every_script_has_a_mistake_below_and_ends_alike():
    assert {words.split()[0] for words, _ in MISTAKES} == set(COMMANDS)
    last = [(SCRIPTS / name).read_text().splitlines()[-1] for name in COMMANDS]
    assert all(line.startswith("    run_script(main") for line in last)


@pytest.mark.parametrize("word", ["0", "-3", "1.5", "many", ""])
def test_a_count_is_a_whole_number_of_at_least_one(word):
    assert positive("12") == 12
    with pytest.raises(argparse.ArgumentTypeError, match=f"^{word} must be a whole number of at least 1$"):
        positive(word)


@pytest.mark.parametrize(("words", "said"), MISTAKES, ids=[words.split()[0] for words, _ in MISTAKES])
def test_a_mistake_is_said_in_a_line(words, said, monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    assert run(words, monkeypatch) == 2
    err = capsys.readouterr().err
    assert said in err and "Traceback" not in err
    assert not list(tmp_path.iterdir()), "nothing is begun"


@pytest.mark.parametrize(
    ("raised", "code", "said"),
    [
        (ConfigError("a=1 must be 2"), 2, "a.py: a=1 must be 2"),
        (EnvironmentFailure("it died"), 3, "a.py: it died"),
        (KeyboardInterrupt(), 130, "a.py: interrupted"),
        (
            subprocess.CalledProcessError(2, ["bin/mappo-eval"], stderr="why\n"),
            2,
            "why\na.py: mappo-eval ended with exit code 2",
        ),
        (subprocess.CalledProcessError(-9, ["mappo-train"]), 1, "a.py: mappo-train ended with exit code -9"),
    ],
)
def test_what_is_raised_becomes_an_exit_code(raised, code, said, monkeypatch, capsys):
    def main() -> None:
        raise raised

    monkeypatch.setattr(sys, "argv", ["scripts/a.py"])
    with pytest.raises(SystemExit) as ended:
        run_script(main)
    assert ended.value.code == code
    assert capsys.readouterr().err == said + "\n"


@pytest.mark.parametrize(("returned", "code"), [(None, None), (0, 0), (1, 1)])
def test_what_is_returned_is_the_exit_code(returned, code):
    with pytest.raises(SystemExit) as ended:
        run_script(lambda: returned)
    assert ended.value.code == code


def test_a_mistake_of_a_programmer_keeps_its_traceback():
    def main() -> None:
        raise KeyError("x")

    with pytest.raises(KeyError):
        run_script(main)
