"""The command that installs an extra is the right one for the place where the package lies."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from mappo_unity.config import extras
from mappo_unity.config.extras import install_command


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Give a folder, with a space in its name, in which the package is made to lie."""
    place = tmp_path / "my place"
    place.mkdir()
    monkeypatch.setattr(extras, "ROOT", place)
    return place


def test_the_place_is_where_the_package_lies() -> None:
    assert (extras.ROOT / "mappo_unity" / "__init__.py").is_file()


@pytest.mark.skipif(sys.platform == "win32", reason="scripts/setup is a shell script")
@pytest.mark.parametrize(
    "wanted, wrong", [("video,pettingzoo", "pettingzoo"), ("video hub", "video hub"), ("hu*", "hu*")]
)
def test_an_extra_that_does_not_exist_is_refused_before_anything_is_installed(
    tmp_path: Path, wanted: str, wrong: str
) -> None:
    (tmp_path / "scripts").mkdir()
    for name in ("pyproject.toml", "scripts/setup"):
        (tmp_path / name).write_bytes((extras.ROOT / name).read_bytes())
    done = subprocess.run(
        ["bash", str(tmp_path / "scripts" / "setup"), wanted], capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 2 and not (tmp_path / ".venv").exists()
    assert done.stderr.startswith(
        f"scripts/setup: there is no extra '{wrong}'; choices: test, sweep, search, "
    )


def make_clone(place: Path) -> None:
    (place / "pyproject.toml").touch()
    (place / "scripts").mkdir()
    (place / "scripts" / "setup").touch()


@pytest.mark.skipif(sys.platform == "win32", reason="scripts/setup is a shell script")
def test_a_clone_with_its_own_environment_has_a_script(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make_clone(place)
    monkeypatch.setattr(sys, "prefix", str(place / ".venv"))
    assert install_command("video") == f"'{place}/scripts/setup' video"
    monkeypatch.chdir(place)
    assert install_command("video") == "./scripts/setup video"


def test_a_clone_in_an_environment_of_the_users_takes_pip(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make_clone(place)
    monkeypatch.setattr(sys, "prefix", str(place.parent / "other"))
    assert install_command("video") == f"pip install --editable '{place}[video]'"
    monkeypatch.chdir(place)
    assert install_command("video") == "pip install --editable '.[video]'"


def test_an_installed_package_names_what_the_extra_brings(place: Path) -> None:
    assert install_command("plot") == "pip install 'matplotlib>=3.8'"
    assert install_command("video") == "pip install 'imageio-ffmpeg>=0.5' 'pillow>=10.1'"
