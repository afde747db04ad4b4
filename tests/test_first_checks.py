"""What can be known without torch is told before torch is loaded, in one helpful line."""

from __future__ import annotations

import json
import os
import shutil
import socket
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from mappo_unity.config.schema import Backend, Config, EnvConfig, EvalConfig, ExportConfig, PlayConfig
from mappo_unity.errors import ConfigError
from mappo_unity.policies.first_checks import (
    check_embedded,
    check_environment,
    check_evaluation,
    check_export,
    check_film,
    check_out,
)
from mappo_unity.policies.policy_files import (
    Kind,
    check_checkpoint,
    check_resumable,
    choose_checkpoint,
    locate,
)
from mappo_unity.runs import checkpoint
from mappo_unity.runs.checkpoint_file import CheckpointError, newest_good, read_plain
from mappo_unity.runs.folder import find_run, write_record

LAYOUTS = {
    "3DBall": {"3DBall": {"team_size": 1, "sensors": [[8]], "continuous": 2, "branches": []}},
    "Basic": {"Basic": {"team_size": 1, "sensors": [[21]], "continuous": 0, "branches": [3]}},
    "SoccerTwos": {
        "SoccerTwos": {"team_size": 2, "sensors": [[264], [72]], "continuous": 0, "branches": [3, 3, 3]}
    },
}
RUNNER = """
import contextlib, io, json, sys
from mappo_unity import cli
for command, *lines in json.loads(sys.argv[1]):
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = getattr(cli, f"{command}_main")(lines)
    print(json.dumps([code, err.getvalue(), "torch" in sys.modules]))
"""


def make_run(folder: Path, env: str) -> Path:
    """Make a run folder with a best checkpoint that has all but weights."""
    folder.mkdir()
    write_record(folder, Config(env=EnvConfig(name=env)), [])
    state = {"layout": LAYOUTS[env], "agent_steps": 7, "env_name": env, "weights": torch.arange(3.0)}
    checkpoint.save_in(folder, 7, state, keep=2, best=True)
    return folder


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with runs and with files of every wrong kind."""
    folder = tmp_path_factory.mktemp("place")
    for name, env in (("ball", "3DBall"), ("basic", "Basic"), ("soccer", "SoccerTwos")):
        make_run(folder / name, env)
    best = (folder / "ball" / "checkpoints" / "best.pt").read_bytes()
    (folder / "cut.pt").write_bytes(best[:-300])
    (folder / "empty.pt").touch()
    (folder / "alone.pt").write_bytes(best)
    torch.save({"a": 1}, folder / "other.pt")
    (folder / "text.txt").write_text("words")
    (folder / "junk.onnx").write_text("words")
    (folder / "ball" / "checkpoints" / "best.onnx").write_text("words")
    (folder / "nothing").mkdir()
    (folder / "broken_league").mkdir()
    (folder / "broken_league" / "league.json").write_text("{")
    (folder / "only_onnx").mkdir()
    (folder / "only_onnx" / "3DBall.onnx").write_text("words")
    (folder / "loop").symlink_to(folder / "loop")
    (folder / "dangling").symlink_to("gone")
    (folder / "Game").write_text("")
    (folder / "Game").chmod(0o755)
    return folder


ONNX = "ball/checkpoints/best.onnx"
TOLD = [
    (
        "train resume=ball/checkpoints/best.onnx",
        "is an ONNX file: it holds a policy, but not what resuming needs",
    ),
    ("train resume=ball/checkpoints/best.onnx", "its run: resume=ball"),
    (
        "train resume=ball/checkpoints/best.onnx",
        f"mappo-eval run={ONNX} and mappo-play env=NAME policy={ONNX}",
    ),
    (
        "train resume=text.txt",
        "text.txt is neither a checkpoint nor an ONNX file: give a run folder or a check",
    ),
    ("train resume=only_onnx", "is a folder of ONNX files: resume takes a run folder or a checkpoint"),
    ("train resume=loop", "resume=loop cannot be opened: it is a symbolic link that leads in a circle"),
    ("train resume=alone.pt", "resume=alone.pt lies in no run folder: there is no config.yaml beside it"),
    ("train env=unity env.file_name=Game", "Game cannot be run on this system: it is empty"),
    ("eval run=cut.pt", "checkpoint cut.pt is damaged or no checkpoint of mappo-unity"),
    ("eval run=empty.pt", "checkpoint empty.pt is damaged or no checkpoint of mappo-unity: it is empty"),
    ("eval run=other.pt", "other.pt is a file of torch, but no checkpoint of mappo-unity"),
    (
        "eval run=text.txt",
        "is neither a checkpoint nor an ONNX file: give random, zoo, a run folder, a checkpoint",
    ),
    ("eval run=junk.onnx env=3DBall", "junk.onnx is no ONNX model that onnxruntime can run"),
    ("eval run=nothing", "run=nothing holds no policy: that folder has none of checkpoints/best.pt"),
    ("eval run=loop", "run=loop cannot be opened: it is a symbolic link that leads in a circle"),
    ("eval run=dangling", "run=dangling is a symbolic link to gone, which does not exist"),
    (f"eval run={'a' * 300}", "cannot be opened: File name too long"),
    (
        "eval run=random",
        "run=random plays anywhere: say in which environment to play it: env=NAME (3DBall, Bas",
    ),
    (
        "eval run=alone.pt",
        "has no config.yaml of a run beside it, which would say where it plays: say in which",
    ),
    ("eval run=alone.pt", "env=3DBall (3DBall, Basic,"),
    (
        "eval run=ball env=unity",
        "env=unity needs options of an environment of your own, which mappo-eval does",
    ),
    ("eval run=ball env=Basic", "run=ball cannot play 'Basic?team=0': it holds the policy '3DBall'"),
    (
        "eval run=ball opponent=random",
        "matches need an environment with two sides (team ids), and this one has 1",
    ),
    ("eval run=soccer opponent=ball", "opponent=ball cannot play 'SoccerTwos?team=1': it holds the policy"),
    ("eval run=ball opponent=text.txt", "opponent=text.txt is neither a checkpoint nor an ONNX file"),
    (
        "eval run=basic",
        "run=basic cannot play 'Basic?team=0': it was trained with observations [21] and actions",
    ),
    ("play run=ball", "there is no display for a window here"),
    ("play run=ball video=film.avi", "video=film.avi must end in one of: .mp4, .gif"),
    ("export run=ball/checkpoints/best.onnx", "is an ONNX file: it needs no export"),
    ("export run=nothing", "run=nothing holds no policy"),
    ("export run=cut.pt", "checkpoint cut.pt is damaged"),
    (
        "export run=ball out=/dev/full",
        "out=/dev/full is neither a file nor a folder, but a device or the like",
    ),
    (
        "export run=ball out=film.mp4",
        "out=film.mp4 does not end in .onnx: ONNX files do, out=film.onnx; a new fo",
    ),
    ("league soccer", "a league needs two policies or more, and has soccer: name them before the options"),
    ("league", "a league needs two policies or more, and has none"),
    ("league soccer nowhere", "policy=nowhere does not exist: give random, zoo, a run folder"),
    ("league soccer soccer", "the policy soccer plays twice: name each policy once"),
    ("league random random env=SoccerTwos", "the policy random plays twice"),
    ("league soccer soccer/checkpoints/best.pt", "plays as soccer and as soccer/checkpoints/best.pt, both"),
    ("league soccer random matches=1", "matches=1 is out of range: matches must be >= 2"),
    ("league soccer random matchs=9", "did you mean matches"),
    ("league soccer matches=4 random", "'random' stands behind matches=4: the policies come first"),
    ("league soccer random --seed 3", "--seed is written seed=3"),
    ("league ball random", "matches need an environment with two sides (team ids), and this one has 1: 3DB"),
    ("league soccer ball", "policy=ball cannot play 'SoccerTwos?team=1': it holds the policy"),
    ("league random alone.pt", "none of the policies lies in the folder of a run"),
    ("league soccer random out=text.txt", "out=text.txt is a file: give a folder for the results"),
    ("league soccer random out=ball", "out=ball is not empty and holds no league: give a new folder"),
    ("league soccer random out=broken_league", "league.json is no record of a league any more"),
    ("league soccer random workers=0", "workers=0 is out of range: workers must be >= 1"),
    ("league soccer random env.file_name=Game", "env.file_name=Game has no effect with env.backend=embedded"),
    ("league soccer random env.backend=editor", "env.backend=editor: a league opens the environment anew"),
    ("league soccer random env=unity env.file_name=gone", "env.file_name=gone: no Unity player"),
    ("player Nope", "there is no scene 'Nope'"),
    ("doctor --prot 3", "--prot is not an option of mappo-doctor (did you mean --port?)"),
]


def test_mistakes_are_told_before_torch_is_loaded(place: Path) -> None:
    lines = [line.split() for line, _ in TOLD]
    clean = {key: value for key, value in os.environ.items() if key not in ("DISPLAY", "WAYLAND_DISPLAY")}
    done = subprocess.run(
        [sys.executable, "-c", RUNNER, json.dumps(lines)],
        capture_output=True,
        text=True,
        cwd=place,
        env=clean | {"PYTHONPATH": str(Path(__file__).resolve().parents[1])},
    )
    assert done.returncode == 0, done.stderr
    for (line, words), answer in zip(TOLD, done.stdout.splitlines(), strict=True):
        code, message, torch_was_loaded = json.loads(answer)
        assert code == 2 and words in message and message.count("\n") == 1, (line, message)
        assert not torch_was_loaded, line


def test_a_film_of_what_cannot_be_drawn(place: Path) -> None:
    with pytest.raises(
        ConfigError, match="env=unity needs options of an environment of your own, which mappo-p"
    ):
        check_film(PlayConfig(env="unity"))
    with pytest.raises(ConfigError, match="env.backend=editor: look at it in Unity"):
        check_embedded(EnvConfig(backend=Backend.editor))


def test_a_player_that_has_gone_is_told_with_the_file_that_names_it(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run", "3DBall")
    config = run / "config.yaml"
    moved = config.read_text().replace("backend: embedded", "backend: player")
    config.write_text(moved.replace("file_name: null", "file_name: gone/Game"))
    with pytest.raises(
        ConfigError, match=f"env.file_name=gone/Game: no Unity player.*; so says {config}, where"
    ):
        check_evaluation(EvalConfig(run=str(run)))
    with pytest.raises(ConfigError, match="mappo-play shows embedded scenes, but this environment has"):
        check_film(PlayConfig(run=str(run)))


def test_plain_values_of_a_checkpoint_are_read_without_its_tensors(place: Path) -> None:
    path = place / "ball" / "checkpoints" / "best.pt"
    state = read_plain(path)
    whole = checkpoint.load(path)
    assert state.keys() == whole.keys() and not isinstance(state["weights"], torch.Tensor)
    assert {k: v for k, v in state.items() if k != "weights"} == {
        k: v for k, v in whole.items() if k != "weights"
    }


def test_a_named_checkpoint_that_is_damaged_is_not_replaced_by_an_older_one(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run", "3DBall")
    newest = checkpoint.save_in(run, 9, {"layout": LAYOUTS["3DBall"]}, keep=2, best=False)
    newest.write_bytes(newest.read_bytes()[:-100])
    assert (
        newest_good(newest)[0].name == "step_000000000007.pt"
    )  # for a training that goes on, with a warning
    assert choose_checkpoint(newest) == newest
    with pytest.raises(CheckpointError, match="step_000000000009.pt is damaged"):
        read_plain(choose_checkpoint(newest))


def test_a_folder_without_a_best_checkpoint_says_which_one_it_takes(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    run = make_run(tmp_path / "run", "3DBall")
    (run / "checkpoints" / "best.pt").unlink()
    newest = checkpoint.save_in(run, 9, {"layout": LAYOUTS["3DBall"]}, keep=2, best=False)
    newest.write_bytes(newest.read_bytes()[:-100])
    assert choose_checkpoint(run).name == "step_000000000007.pt"
    assert "step_000000000009.pt is damaged" in caplog.text and "step_000000000007.pt is taken" in caplog.text


def test_a_damaged_best_checkpoint_names_the_others(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run", "3DBall")
    best = run / "checkpoints" / "best.pt"
    data = best.read_bytes()
    best.unlink()  # a hard link of the numbered one
    best.write_bytes(data[:-100])
    with pytest.raises(
        CheckpointError, match=r"best.pt is damaged.*its run has others: .*step_000000000007.pt$"
    ):
        check_checkpoint(locate(str(run), "run"))


def test_what_cannot_be_exported_is_told_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = tmp_path / "run"
    run.mkdir()
    shared = {"SoccerTwos": {"share_parameters": True}}
    state = {"layout": LAYOUTS["SoccerTwos"], "model": shared}
    checkpoint.save_in(run, 7, state, keep=2, best=True)
    check_export(ExportConfig(run=str(run)))

    apart = {"SoccerTwos": {"share_parameters": False}}
    checkpoint.save_in(run, 9, state | {"model": apart}, keep=2, best=True)
    with pytest.raises(ConfigError, match="a network for each member of a team cannot be exported"):
        check_export(ExportConfig(run=str(run)))
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(ConfigError, match=r"the package onnxruntime is needed for ONNX files"):
        check_export(ExportConfig(run=str(run)))


def test_a_run_is_found_from_inside_its_folder(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    checkpoints = place / "ball" / "checkpoints"
    assert locate(str(checkpoints), "run").path == place / "ball"
    monkeypatch.chdir(checkpoints)
    assert find_run(Path("best.pt"), "run").samefile(place / "ball")
    assert find_run(Path("."), "run").samefile(place / "ball")
    assert locate(".", "run").kind is Kind.run and choose_checkpoint(Path(".")).samefile("best.pt")


def test_an_export_into_a_run_folder_does_not_hide_its_checkpoints(place: Path, tmp_path: Path) -> None:
    run = shutil.copytree(place / "ball", tmp_path / "run")
    (run / "3DBall.onnx").write_text("an export")
    assert locate(str(run), "run").kind is Kind.run
    check_resumable(run, "resume")


@pytest.mark.parametrize(
    ("out", "words"),
    [
        ("text.txt", "is a file that is there already, of another kind: give a file NAME.onnx, or a folder"),
        ("text.txt/x.onnx", "text.txt is a file, not a folder"),
        (
            "best.ONNX",
            "does not end in .onnx: ONNX files do, out=best.onnx; a new folder of that name is out=best.O",
        ),
        ("loop", "Too many levels of symbolic links"),
        ("dangling", "is a symbolic link that leads nowhere"),
        ("/dev/null", "is neither a file nor a folder"),
    ],
)
def test_places_that_take_no_export(
    out: str, words: str, place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(place)
    with pytest.raises(ConfigError) as error:
        check_out(out)
    assert words in str(error.value)


def test_places_that_take_an_export(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(place)
    for out in ("new.onnx", "nothing", "new/folder", "exports.v1.2", "best.pt/", "only_onnx/3DBall.onnx"):
        check_out(out)
    monkeypatch.setattr("mappo_unity.policies.first_checks.os.access", lambda path, mode: False)
    with pytest.raises(ConfigError, match="no permission to write in the folder nothing"):
        check_out("nothing")


def test_the_port_of_the_editor_is_looked_at_first() -> None:
    with socket.socket() as holder:
        holder.bind(("127.0.0.1", 0))
        holder.listen()
        port = holder.getsockname()[1]
        config = Config(env=EnvConfig(backend=Backend.editor, port=port))
        with pytest.raises(ConfigError, match=rf"port {port} of 127.0.0.1 is in use.*\(env.port\)"):
            check_environment(config)
