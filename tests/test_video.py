"""Videos: pictures show what stands where, files are whole or absent."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import numpy as np
import pytest
from films import CAMERA, SIZE, frames_of, gif_durations_ms, where

from mappo_unity.cli import play_main
from mappo_unity.config.extras import install_command
from mappo_unity.errors import ConfigError
from mappo_unity.scenes.core.shapes import (
    BLUE,
    GREEN,
    RED,
    WHITE,
    Camera,
    Shape,
    ball,
    box,
    capsule,
    yaw_rotation,
)
from mappo_unity.viewing.antialias import smooth_edges
from mappo_unity.viewing.caption import draw_caption
from mappo_unity.viewing.render import Renderer
from mappo_unity.viewing.video import VideoFile, check_video


def test_pictures_show_right_up_and_ahead_as_unity_does(renderer: Renderer) -> None:
    shapes = [ball((2, 0, 0), 0.5, RED), ball((0, 0, 3), 0.5, GREEN), ball((-2, 0, 0), 0.5, BLUE)]
    frame = renderer.frame(shapes, CAMERA)
    assert frame.shape == (96, 160, 3) and frame.dtype == np.uint8
    red, green, blue = (where(frame, color) for color in (RED, GREEN, BLUE))
    assert red[0] > 100 and blue[0] < 60 and abs(red[1] - 48) < 4
    assert abs(green[0] - 80) < 3 and green[1] < 40 and green[2] < red[2]  # ahead: higher, smaller
    up = where(renderer.frame([ball((0, 1.5, 0), 0.5, RED)], CAMERA), RED)
    assert abs(up[0] - 80) < 3 and up[1] < 35
    turned = Camera(CAMERA.target, 12.0, yaw=90.0, pitch=30.0)  # looking to the right: x is ahead now
    red = where(renderer.frame([ball((2, 0, 0), 0.5, RED)], turned), RED)
    assert abs(red[0] - 80) < 3 and red[1] < 42


def test_pictures_turn_shapes_as_unity_does(renderer: Renderer) -> None:
    above = Camera((0.0, 0.0, 0.0), 12.0, yaw=0.0, pitch=89.0)
    bar = box((0, 0, 0), (0.2, 0.2, 3.0), RED, yaw_rotation(np.pi / 4))
    frame = renderer.frame([bar], above)
    half = frame[:48], frame[48:]
    assert where(half[0], RED)[0] > 90 and where(half[1], RED)[0] < 70  # ahead and to the right
    pole = renderer.frame([capsule((0, 0, 0), 0.2, 2.0, GREEN)], Camera((0, 0, 0), 12.0, pitch=0.0))
    rows = np.nonzero(pole[..., 1].astype(int) - pole[..., 0] > 60)[0]
    assert np.ptp(rows) > 40


def test_a_nearer_shape_hides_a_farther_one(renderer: Renderer) -> None:
    level = Camera((0, 0, 0), 12.0, pitch=0.0)
    wall = box((0, 0, -2), (2, 2, 0.1), GREEN)
    frame = renderer.frame([ball((0, 0, 0), 0.5, RED), wall], level)
    assert (frame[48, 80] == frame[48, 80].max()).tolist() == [False, True, False]


@pytest.mark.parametrize("suffix", ["mp4", "gif"])
def test_videos_hold_every_frame(tmp_path: Path, needs_video: None, suffix: str) -> None:
    path = tmp_path / f"film.{suffix}"
    with VideoFile(path, CAMERA, SIZE, fps=10) as film:
        for step in range(7):
            assert film.show([ball((step - 3, 0, 0), 0.8, RED)], CAMERA)
            assert not path.exists()
    frames = frames_of(path)
    assert len(frames) == 7 and frames[0].shape[:2] == (96, 160)
    columns = [where(frame, RED)[0] for frame in frames]
    assert np.diff(columns).min() > 5
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(("fps", "frames"), [(25.0 + 1e-6, 50), (30, 45), (1 / 0.15, 20)])
def test_a_gif_lasts_as_long_as_its_scene(tmp_path: Path, needs_video: None, fps: float, frames: int) -> None:
    with VideoFile(tmp_path / "film.gif", CAMERA, SIZE, fps) as film:
        for step in range(frames):
            film.write(np.full((96, 160, 3), 5 * step, np.uint8))
    durations_ms = gif_durations_ms(tmp_path / "film.gif")
    assert len(durations_ms) == frames
    assert abs(sum(durations_ms) - 1000 * frames / fps) <= 5
    assert max(durations_ms) - min(durations_ms) <= 10


def test_a_film_that_breaks_off_leaves_nothing(tmp_path: Path, needs_video: None) -> None:
    with pytest.raises(KeyboardInterrupt), VideoFile(tmp_path / "film.mp4", CAMERA, SIZE, 10) as film:
        film.show([ball((0, 0, 0), 0.8, RED)], CAMERA)
        raise KeyboardInterrupt
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("suffix", ["mp4", "gif"])
@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_a_signal_ends_a_film_and_leaves_nothing(
    tmp_path: Path,
    needs_video: None,
    suffix: str,
    number: signal.Signals,
    code: int,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    write = VideoFile.write

    def write_and_end(film: VideoFile, frame: np.ndarray) -> None:
        write(film, frame)
        assert [file.suffix for file in tmp_path.iterdir()] == [".part"]
        os.kill(os.getpid(), number)

    monkeypatch.setattr(VideoFile, "write", write_and_end)
    before = signal.signal(signal.SIGTERM, signal.SIG_IGN)
    try:
        lines = ["env=Basic", f"video={tmp_path / 'film'}.{suffix}", "seconds=3", "width=96", "height=64"]
        assert play_main(lines) == code
        assert signal.getsignal(signal.SIGTERM) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGTERM, before)
    assert not list(tmp_path.iterdir()) and capsys.readouterr().err == "mappo-play: interrupted\n"


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a device that is always full")
@pytest.mark.parametrize("suffix", ["mp4", "gif"])
def test_a_full_disk_is_told_and_leaves_the_film_that_was_there(
    tmp_path: Path, needs_video: None, suffix: str, capfd: pytest.CaptureFixture[str]
) -> None:
    video = tmp_path / f"film.{suffix}"
    video.write_text("an older film")
    (tmp_path / f".film.{os.getpid()}.part").symlink_to("/dev/full")
    lines = ["env=Basic", f"video={video}", "seconds=30", "width=96", "height=64"]
    assert play_main(lines) == 2
    told = capfd.readouterr().err.strip()
    assert told.startswith(f"mappo-play: video={video} cannot be written: ") and "\n" not in told
    assert "No space left on device" in told
    assert list(tmp_path.iterdir()) == [video] and video.read_text() == "an older film"


def test_an_encoder_that_fails_without_a_word_is_told(
    tmp_path: Path, needs_video: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "ffmpeg").write_text("#!/bin/sh\ncat > /dev/null\nexit 3\n")
    (tmp_path / "ffmpeg").chmod(0o755)
    monkeypatch.setattr("imageio_ffmpeg.get_ffmpeg_exe", lambda: str(tmp_path / "ffmpeg"))
    with (
        pytest.raises(ConfigError, match=r"film.mp4 cannot be written: ffmpeg ended with exit code 3; give"),
        VideoFile(tmp_path / "film.mp4", CAMERA, SIZE, 10) as film,
    ):
        film.show([ball((0, 0, 0), 0.8, RED)], CAMERA)
    assert [file.name for file in tmp_path.iterdir()] == ["ffmpeg"]


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="needs a folder that takes no files from anyone")
def test_a_folder_that_takes_no_files_is_told(
    needs_video: None, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("os.access", lambda *_: True)  # as the superuser is told of /proc
    assert play_main(["env=Basic", "video=/proc/film.gif"]) == 2
    told = capsys.readouterr().err.strip()
    assert told.startswith("mappo-play: video=/proc/film.gif cannot be written: ") and "\n" not in told
    assert play_main(["env=Basic", f"video=/tmp/{300 * 'x'}.gif"]) == 2
    assert "cannot be written: File name too long; give a file" in capsys.readouterr().err


def test_videos_that_cannot_be_written_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ConfigError, match=r"film.avi must end in one of: .mp4, .gif"):
        check_video(tmp_path / "film.avi")
    with pytest.raises(ConfigError, match=r"missing/film.mp4 cannot be written: .*missing must be a folder"):
        check_video(tmp_path / "missing" / "film.mp4")
    monkeypatch.setitem(__import__("sys").modules, "imageio_ffmpeg", None)
    with pytest.raises(ConfigError, match=r"needs the package imageio_ffmpeg: ") as caught:
        check_video(tmp_path / "film.mp4")
    assert install_command("video") in str(caught.value)
    monkeypatch.undo()
    monkeypatch.setitem(__import__("sys").modules, "PIL", None)
    monkeypatch.setitem(__import__("sys").modules, "imageio_ffmpeg", __import__("types"))
    check_video(tmp_path / "film.mp4")
    with pytest.raises(ConfigError, match="caption=true needs the package PIL: "):
        check_video(tmp_path / "film.mp4", caption=True)


def test_a_machine_without_opengl_is_told_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    monkeypatch.setitem(__import__("sys").modules, "mujoco.osmesa", None)
    with pytest.raises(ConfigError, match=r"OpenGL with osmesa .* apt-get install libegl1 libgl1-mesa-dri"):
        Renderer(CAMERA, *SIZE)


@pytest.mark.parametrize("slope", [0.0, 0.2, -0.35, 2.5])
def test_smoothed_edges_are_nearer_to_the_share_of_each_pixel_that_is_covered(slope: float) -> None:
    fine = np.arange(0, 48, 1 / 8) + 1 / 16  # eight samples a pixel, each way
    covered = fine[:, None] > 20.3 + slope * (fine[None, :] - 20)
    share = covered.reshape(48, 8, 48, 8).mean((1, 3))
    frame = np.where(covered[4::8, 4::8, None], np.uint8([200, 40, 60]), np.uint8([90, 160, 240]))
    rough = frame.copy()
    smooth_edges(frame)
    true = share[..., None] * [200, 40, 60] + (1 - share[..., None]) * [90, 160, 240]
    inside = np.s_[14:-14, 14:-14]  # both ends of a step within the picture
    errors = [np.abs(picture - true)[inside].mean() for picture in (rough, frame)]
    assert errors[1] <= (0.55 if slope else 1) * errors[0]
    untouched = (share < 0.01) | (share > 0.99)
    far = np.array(
        [untouched[max(0, r - 1) : r + 2, max(0, c - 1) : c + 2].all() for r, c in np.ndindex(48, 48)]
    )
    assert (frame.reshape(-1, 3)[far] == rough.reshape(-1, 3)[far]).all()


def test_a_picture_without_edges_stays_as_it_is() -> None:
    frame = np.full((64, 64, 3), 90, np.uint8)
    smooth_edges(frame)
    assert (frame == 90).all()


@pytest.mark.parametrize("place", [(0.0, 0.0, 0.0), (30.0, 0.0, -40.0)])
def test_shadows_fall_wherever_the_camera_looks(
    renderer: Renderer, place: tuple[float, float, float]
) -> None:
    floor = box((place[0], -0.1, place[2]), (8, 0.1, 8), WHITE, shadow=False)
    middle, camera = (place[0], 1.5, place[2]), Camera(place, 12.0, pitch=50.0)

    def darker(thing: Shape) -> int:
        bare, shown = (renderer.frame(shapes, camera).astype(int) for shapes in ([floor], [floor, thing]))
        drop = bare - shown
        return int(((drop > 40) & (np.ptp(shown, axis=-1, keepdims=True) < 20)).all(-1).sum())

    assert darker(box(middle, (1, 1, 1), RED)) > 100
    assert darker(box(middle, (1, 1, 1), RED, shadow=False)) < 20


def test_a_caption_is_a_line_over_the_lower_edge() -> None:
    pytest.importorskip("PIL")
    parts = ["SoccerTwos", "12.3 s", "blue 1 : 0 purple"]
    for width, height in ((960, 544), (480, 272), (160, 96)):
        frame = np.full((height, width, 3), 120, np.uint8)
        draw_caption(frame, parts)
        again = np.full((height, width, 3), 120, np.uint8)
        draw_caption(again, parts)
        assert (frame == again).all()
        changed = np.flatnonzero((frame != 120).any((1, 2)))
        assert changed[-1] == height - 1 and changed.size == np.ptp(changed) + 1 <= max(26, height / 10)
        strip = frame[changed[0] :]
        assert strip.max() > 240 and np.median(strip) < 50  # bright letters on a dark line
        letters = np.flatnonzero((strip > 200).any((0, 2)))
        assert letters[0] < 20 and letters[-1] < width - 3


def test_what_does_not_fit_into_a_caption_goes_and_the_score_stays() -> None:
    pytest.importorskip("PIL")
    parts = ["GridFoodCollector", "1.2 s", "return 0.50", "last episode 3.00"]

    def line(width: int, parts: list[str]) -> bytes:
        frame = np.full((96, width, 3), 120, np.uint8)
        draw_caption(frame, parts)
        return frame.tobytes()

    assert line(1000, parts) != line(1000, parts[:3])
    assert line(270, parts) == line(270, parts[:3])
    assert line(150, parts) == line(150, parts[1:3])
    assert line(80, parts) == line(80, parts[2:3]) != line(80, [""])


def test_figures_that_change_do_not_move_what_follows() -> None:
    pytest.importorskip("PIL")
    first, second = np.zeros((2, 272, 480, 3), np.uint8)
    draw_caption(first, ["Basic", "1.1 s", "return 0.50"])
    draw_caption(second, ["Basic", "8.8 s", "return 0.50"])
    columns = np.flatnonzero((first != second).any((0, 2)))
    assert 0 < columns.size <= np.ptp(columns) + 1 < 40
