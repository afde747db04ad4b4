"""Whether something can be drawn here is known before torch is loaded."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from mappo_unity.config.schema import PlayConfig
from mappo_unity.errors import ConfigError
from mappo_unity.scenes.mujoco_check import check_mujoco
from mappo_unity.viewing.screens import check_screen


def test_an_opengl_that_mujoco_cannot_load(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(name: str) -> None:
        raise RuntimeError(f"invalid value\nfor {name}")

    monkeypatch.setattr("mappo_unity.scenes.mujoco_check.importlib.import_module", fail)
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    check_mujoco()
    monkeypatch.setenv("MUJOCO_GL", "nonsense")
    with pytest.raises(ConfigError, match=r"MUJOCO_GL=nonsense \(invalid value for mujoco\): unset it"):
        check_screen(PlayConfig(env="Basic"))


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere there is always a display")
def test_an_opengl_that_needs_a_display(monkeypatch: pytest.MonkeyPatch) -> None:
    from mappo_unity.viewing.render import check_opengl

    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    for choice in ("glfw", "off"):
        monkeypatch.setenv("MUJOCO_GL", choice)
        with pytest.raises(ConfigError, match=r"by OpenGL with glfw \(it needs a display\)"):
            check_opengl()


def test_an_ending_or_a_package_that_is_missing(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"film.avi must end in one of: .mp4, .gif"):
        check_screen(PlayConfig(env="Basic", video=str(tmp_path / "film.avi")))
    monkeypatch.setitem(sys.modules, "PIL", None)
    with pytest.raises(ConfigError, match=r"film.gif needs the package PIL"):
        check_screen(PlayConfig(env="Basic", video=str(tmp_path / "film.gif")))


def test_a_display_that_takes_no_window(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.setenv("DISPLAY", ":9999")
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(ConfigError, match="no window can be opened on the display; video=FILE.mp4"):
        check_screen(PlayConfig(env="Basic"))
