"""Pushing to and pulling from the hub: a fake one on loopback, and every message."""

import errno
import re
import shutil

import pytest
import yaml

from mappo_unity.cli import eval_main, hub_main
from mappo_unity.policies.policy_files import ZOO_FOLDER
from mappo_unity.sharing.card import Facts, card_text, is_ours

pytest.importorskip("huggingface_hub")
from fake_hub import TOKEN, FakeHub
from huggingface_hub import constants


@pytest.fixture
def hub(monkeypatch, tmp_path):
    """Return a running fake hub to which this process is logged in; its cache is empty."""
    server = FakeHub()
    monkeypatch.setattr(constants, "ENDPOINT", server.url)
    template = server.url + "/{repo_id}/resolve/{revision}/{filename}"
    monkeypatch.setattr(constants, "HUGGINGFACE_CO_URL_TEMPLATE", template)
    monkeypatch.setattr(constants, "HF_HUB_DISABLE_XET", True)
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", False)
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(constants, "HF_TOKEN_PATH", str(tmp_path / "no_token"))
    monkeypatch.setenv("HF_TOKEN", TOKEN)
    yield server
    server.shutdown()
    server.server_close()


@pytest.fixture
def policies(tmp_path):
    """Return a folder with two ONNX files, one of them under another name than its behavior's."""
    folder = tmp_path / "policies"
    folder.mkdir()
    shutil.copy(ZOO_FOLDER / "Basic.onnx", folder / "best.onnx")
    shutil.copy(ZOO_FOLDER / "PushBlock.onnx", folder)
    return folder


def test_what_is_pushed_is_what_is_pulled(hub, policies, tmp_path, capsys):
    (policies / "film.mp4").write_bytes(b"film")
    assert hub_main(["push", str(policies), "repo=me/two", "private=true", "message=first"]) == 0
    files = hub.repos["me/two"]
    assert set(files) == {"Basic.onnx", "PushBlock.onnx", "README.md", "film.mp4"}
    assert files["Basic.onnx"] == (ZOO_FOLDER / "Basic.onnx").read_bytes()
    assert hub.commits == ["first"] and hub.made[0]["visibility"] == "private"

    card = files["README.md"].decode()
    assert yaml.safe_load(card.split("---\n")[1])["library_name"] == "mappo-unity"
    assert "# Basic\n" in card and "# PushBlock\n" in card and "best.onnx" not in card

    out = tmp_path / "pulled"
    assert hub_main(["pull", "me/two", f"out={out}"]) == 0
    assert {path.name: path.read_bytes() for path in out.iterdir()} == files
    assert eval_main([f"run={out}", "env=Basic", "episodes=2"]) == 0
    said = capsys.readouterr()
    assert TOKEN not in said.out + said.err


def test_a_file_goes_with_its_own_card_and_film(hub, policies):
    (policies / "best.md").write_text("---\ntags: [mine]\n---\nmy words on best.onnx")
    (policies / "best.mp4").write_bytes(b"film")
    (policies / "other.mp4").write_bytes(b"another")
    assert hub_main(["push", str(policies / "best.onnx"), "repo=me/one"]) == 0
    assert set(hub.repos["me/one"]) == {"Basic.onnx", "README.md", "best.mp4"}
    assert b"my words on best.onnx" in hub.repos["me/one"]["README.md"]


def test_a_readme_of_the_users_own_goes_as_it_is(hub, policies):
    (policies / "README.md").write_text("mine")
    assert hub_main(["push", str(policies), "repo=me/two"]) == 0
    assert hub.repos["me/two"]["README.md"] == b"mine"


def test_what_was_pulled_is_pushed_with_the_card_that_came_with_it(hub, policies, tmp_path):
    (policies / "best.md").write_text(
        card_text(Facts("Basic", "best.onnx", "Basic", 7, [], 0, "", film="b.mp4"))
    )
    (policies / "PushBlock.onnx").unlink()
    assert hub_main(["push", str(policies), "repo=me/one"]) == 0
    card = hub.repos["me/one"]["README.md"]
    assert is_ours(card.decode()) and b"after 7 agent steps" in card and b"[Film](b.mp4)" in card

    out = tmp_path / "pulled"
    assert hub_main(["pull", "me/one", f"out={out}"]) == 0
    assert hub_main(["push", str(out), "repo=me/again"]) == 0
    assert hub.repos["me/again"]["README.md"] == card

    # a card beside its model is newer
    (out / "Basic.md").write_text("mine")
    assert hub_main(["push", str(out), "repo=me/again"]) == 0
    assert hub.repos["me/again"]["README.md"] == b"mine"


def test_only_policies_come_and_nothing_is_overwritten(hub, tmp_path, capsys):
    data = (ZOO_FOLDER / "Basic.onnx").read_bytes()
    hub.repos["me/more"] = {"Basic.onnx": data, "sub/Other.onnx": data, "run.py": b"x", "../up.onnx": data}
    out = tmp_path / "out"
    assert hub_main(["pull", "me/more", f"out={out}", "revision=main"]) == 0
    assert [path.name for path in out.iterdir()] == ["Basic.onnx"]

    assert hub_main(["pull", "me/more", f"out={out}"]) == 2
    assert "nothing is overwritten" in capsys.readouterr().err

    hub.repos["me/none"] = {"a.txt": b"x"}
    assert hub_main(["pull", "me/none", f"out={tmp_path}/new"]) == 2
    assert "holds no policy" in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    ("lines", "said"),
    [
        ([], "nothing that mappo-hub does"),
        (["fetch", "me/x"], "'fetch' is nothing"),
        (["push", "{zoo}"], "repo"),
        (["push", "{zoo}", "repo=x"], "no name of a repository"),
        (["push", "{zoo}", "repo=me/a--b"], "no name of a repository"),
        (["pull", "me/.."], "no name of a repository"),
        (["push", "{zoo}", "repo=me/x", "token=abc"], "token"),
        (["push", "random", "repo=me/x"], "nothing to upload"),
        (["push", "{empty}", "repo=me/x"], "holds no policy"),
        (["push", "{empty}/gone", "repo=me/x"], "does not exist"),
        (["push", "{zoo}/Basic.onnx", "repo=locked/x"], "may not be written"),
        (["pull", "me/unknown"], "is not on the hub"),
        (["pull", "me/there", "revision=v9", "out={empty}/new"], "revision=v9 is no branch"),
    ],
)
def test_mistakes_are_told_in_a_line(hub, tmp_path, capsys, monkeypatch, lines, said):
    empty = tmp_path / "empty"
    empty.mkdir()
    monkeypatch.chdir(empty)
    hub.read_only.add("locked")
    hub.repos["me/there"] = {}
    assert hub_main([line.format(zoo=ZOO_FOLDER, empty=empty) for line in lines]) == 2
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1
    assert not list(empty.iterdir()) and not hub.commits


def test_a_readme_that_the_hub_refuses_is_told(hub, policies, capsys):
    (policies / "README.md").write_bytes(b"caf\xe9")
    assert hub_main(["push", str(policies), "repo=me/x"]) == 2
    assert "README.md is no UTF-8 text (byte 3)" in capsys.readouterr().err and not hub.made

    (policies / "README.md").write_text("---\nlicense: foo\n---\nmine")
    assert hub_main(["push", str(policies), "repo=me/x"]) == 2
    error = capsys.readouterr().err
    assert "the hub refused repo=me/x: Invalid metadata in README.md" in error and error.count("\n") == 1
    assert '"license" must be one of [mit]' in error and not hub.commits

    (policies / "README.md").write_text("---\nlicense: mit\n---\nmine")
    assert hub_main(["push", str(policies), "repo=me/x"]) == 0


def test_two_files_of_one_behavior_are_not_pushed(hub, policies, capsys):
    shutil.copy(ZOO_FOLDER / "Basic.onnx", policies)
    assert hub_main(["push", str(policies), "repo=me/x"]) == 2
    assert "both of the behavior Basic" in capsys.readouterr().err


def test_who_is_not_logged_in_is_told(hub, monkeypatch, capsys):
    lines = ["push", str(ZOO_FOLDER / "Basic.onnx"), "repo=me/x"]
    monkeypatch.setenv("HF_TOKEN", "hf_wrong")
    assert hub_main(lines) == 2
    error = capsys.readouterr().err
    assert "does not take the token" in error and "hf_wrong" not in error

    monkeypatch.delenv("HF_TOKEN")
    assert hub_main(lines) == 2
    assert "nobody is logged in" in capsys.readouterr().err


@pytest.mark.parametrize("lines", [["pull", "me/x"], ["push", str(ZOO_FOLDER / "Basic.onnx"), "repo=me/x"]])
def test_a_hub_out_of_reach_ends_with_3(hub, monkeypatch, tmp_path, capsys, lines):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(constants, "ENDPOINT", "http://127.0.0.1:9")
    assert hub_main(lines) == 3
    assert "cannot be reached" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (PermissionError(errno.EACCES, "Permission denied", "/cache/x"), "/cache/x cannot be .*denied"),
        (OSError(errno.ENOSPC, "No space left on device"), "the hub's cache .*/cache cannot be .*No space"),
    ],
)
def test_a_disk_that_refuses_is_no_network(hub, monkeypatch, tmp_path, capsys, error, words):
    def refuse(*arguments, **options):
        raise error

    monkeypatch.setattr("huggingface_hub.HfApi.hf_hub_download", refuse)
    hub.repos["me/x"] = {"Basic.onnx": b"x"}
    assert hub_main(["pull", "me/x", f"out={tmp_path}/new"]) == 2
    assert re.search(words, capsys.readouterr().err)

    error.filename, error.errno = None, errno.ECONNRESET
    assert hub_main(["pull", "me/x", f"out={tmp_path}/new"]) == 3


def test_a_missing_package_names_its_extra(hub, monkeypatch, capsys):
    monkeypatch.setitem(__import__("sys").modules, "huggingface_hub.errors", None)
    assert hub_main(["pull", "me/x"]) == 2
    assert "hub" in capsys.readouterr().err
