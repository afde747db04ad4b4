"""Films: pictures show what stands where, files are whole or absent, mappo-play plays what it is told."""

from __future__ import annotations

import importlib
import os
import signal
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mappo_unity import runs
from mappo_unity.cli import play_main
from mappo_unity.config import (
    CollectConfig,
    Config,
    ConfigError,
    EnvConfig,
    LogConfig,
    ModelConfig,
    PlayConfig,
    PPOConfig,
)
from mappo_unity.onnx_policy import OnnxFolder
from mappo_unity.play import Pace, open_scene, play, policy_of
from mappo_unity.render import Renderer
from mappo_unity.scenes.drawings import drawing_of
from mappo_unity.scenes.drawings.shapes import (
    BLUE,
    GREEN,
    RED,
    Camera,
    Color,
    ball,
    box,
    capsule,
    yaw_rotation,
)
from mappo_unity.video import VideoFile, check_video
from mappo_unity.window import Window

SIZE = (160, 96)
CAMERA = Camera((0.0, 0.0, 0.0), 12.0, yaw=0.0, pitch=30.0)


@pytest.fixture(scope="module")
def renderer() -> Any:
    """Return a renderer; skip where no OpenGL works."""
    try:
        made = Renderer(CAMERA, *SIZE)
    except ConfigError as error:
        pytest.skip(str(error))
    yield made
    made.close()


@pytest.fixture
def needs_video(renderer: Renderer) -> None:
    """Skip where no video can be written."""
    importlib.import_module("mappo_unity.video")
    pytest.importorskip("imageio_ffmpeg")


def where(frame: np.ndarray, color: Color) -> tuple[float, float, int]:
    """Return column and row of the middle of what has a colour, and its number of pixels."""
    channel = int(np.argmax(color[:3]))
    others = [i for i in range(3) if i != channel]
    strong = frame[..., channel].astype(int) - frame[..., others].max(axis=-1).astype(int) > 70
    rows, columns = np.nonzero(strong)
    return float(columns.mean()), float(rows.mean()), rows.size


def frames_of(path: Path) -> list[np.ndarray]:
    """Return the frames of a film."""
    if path.suffix == ".gif":
        with importlib.import_module("PIL.Image").open(path) as image:
            pages = importlib.import_module("PIL.ImageSequence").Iterator(image)
            return [np.array(page.convert("RGB")) for page in pages]
    reader = importlib.import_module("imageio_ffmpeg").read_frames(str(path))
    width, height = next(reader)["size"]
    return [np.frombuffer(frame, np.uint8).reshape(height, width, 3) for frame in reader]


def gif_durations_ms(path: Path) -> list[int]:
    """Return how long each frame of a GIF is shown."""
    with importlib.import_module("PIL.Image").open(path) as image:
        durations = []
        for number in range(image.n_frames):
            image.seek(number)
            durations.append(image.info["duration"])
    return durations


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
    with pytest.raises(
        ConfigError, match=r"needs the package imageio_ffmpeg: pip install 'mappo-unity\[video"
    ):
        check_video(tmp_path / "film.mp4")


def test_a_machine_without_opengl_is_told_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    monkeypatch.setitem(__import__("sys").modules, "mujoco.osmesa", None)
    with pytest.raises(ConfigError, match=r"OpenGL with osmesa .* apt-get install libegl1 libgl1-mesa-dri"):
        Renderer(CAMERA, *SIZE)


def test_films_run_at_the_pace_of_their_scene() -> None:
    pace = Pace(drawing_of("3DBall"), seconds=4)  # ticks of 0.02 s, two a frame
    assert (pace.ticks, pace.fps, pace.frames) == (2, pytest.approx(25), 100)
    pace = Pace(drawing_of("Basic"), seconds=3)  # Unity plays Basic at 0.15 s a decision
    assert (pace.ticks, pace.fps, pace.frames) == (1, pytest.approx(1 / 0.15), 20)


def test_random_actions_are_filmed(tmp_path: Path, needs_video: None) -> None:
    video = tmp_path / "basic.mp4"
    shown = play(PlayConfig(env="Basic", video=str(video), seconds=6, width=96, height=64))
    assert shown["scene"] == "Basic" and shown["policy"] == "random" and shown["frames"] == 40
    assert shown["episodes"] >= 1 and -1 < shown["mean_return"] <= 0.93
    assert len(frames_of(video)) == 40


def test_a_run_is_filmed_from_the_command_line(
    tmp_path: Path, needs_video: None, capsys: pytest.CaptureFixture[str]
) -> None:
    cfg = Config(
        env=EnvConfig(num_areas=2),
        model=ModelConfig(hidden=[8]),
        ppo=PPOConfig(minibatch_size=16),
        collect=CollectConfig(rounds=8),
        log=LogConfig(backends=[], progress=False),
        max_steps=16,
    )
    run = tmp_path / "run"
    run.mkdir()
    runs.write_record(run, cfg, [])
    train = importlib.import_module("mappo_unity.train").train
    train(cfg, run, None)
    video = tmp_path / "film.mp4"
    lines = [f"run={run}", f"video={video}", "seconds=0.4", "width=96", "height=64", "deterministic=true"]
    assert play_main(lines) == 0
    assert f"{video}: 0.4 s of 3DBall played by {run}, 10 frames" in capsys.readouterr().out
    assert video.stat().st_size > 1000


def test_a_folder_of_onnx_files_plays_every_behavior(shared: Path) -> None:
    cfg = PlayConfig(env="WallJump", policy=str(shared / "oracle"))
    scene = open_scene(cfg)
    policy = policy_of(cfg, scene)
    assert scene.num_areas == 1 and isinstance(policy, OnnxFolder)
    cfg = PlayConfig(env="Basic", policy=str(shared / "oracle"))
    with pytest.raises(
        ConfigError, match=r"'Basic\?team=0' needs a file .*Basic.onnx; there are 3DBall.onnx"
    ):
        policy_of(cfg, open_scene(cfg))
    cfg = PlayConfig(env="Basic", policy=str(shared / "oracle" / "3DBall.onnx"))
    with pytest.raises(ConfigError, match=r"3DBall.onnx cannot play 'Basic\?team=0'"):
        policy_of(cfg, open_scene(cfg))


@pytest.mark.skipif("DISPLAY" not in os.environ, reason="needs a display (xvfb-run pytest ...)")
def test_a_window_shows_frames_at_their_time() -> None:
    start = time.monotonic()
    with Window(CAMERA, SIZE, fps=20, title="test") as window:
        assert all(window.show([ball((0, 0, 0), 1.0, RED)], CAMERA) for _ in range(10))
    assert time.monotonic() - start > 0.4


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ([], "neither run nor env is given"),
        (["run=a", "policy=b.onnx"], "both say who plays"),
        (["env=Basic", "width=63"], "width=63 is out of range: width must be even"),
        (["env=Basic", "seconds=0"], "seconds=0.0 is out of range"),
        (["env=Basic", "video=film.avi"], "must end in one of"),
        (["env=custom", "video=film.mp4"], "env.factory is not given"),
        (["env=Nope", "video=film.mp4"], "env=Nope does not exist"),
        (["run=nowhere", "video=film.mp4"], "run=nowhere does not exist"),
        (["env=Basic", "policy=none.onnx", "video=film.gif"], "policy=none.onnx does not exist"),
        (
            ["env=Basic", "policy=.", "video=film.gif"],
            "policy=. holds no policy: that folder has none of checkpoints/best.pt, "
            "checkpoints/step_*.pt, *.onnx\n",
        ),
        (["env=Basic"], "there is no display"),
    ],
)
def test_mistakes_are_told(
    lines: list[str],
    message: str,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setattr("sys.platform", "linux")
    assert play_main(lines) == 2
    assert message in capsys.readouterr().err and not list(tmp_path.iterdir())


def test_help_names_every_option(capsys: pytest.CaptureFixture[str]) -> None:
    assert play_main(["--help"]) == 0
    text = capsys.readouterr().out
    assert (
        all(f"  {name}: " in text for name in vars(PlayConfig(env="Basic"))) and "mappo-play run=RUN" in text
    )
