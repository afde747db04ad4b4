"""mappo-play shows what it is told, at the pace of the scene."""

from __future__ import annotations

import importlib
import os
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from films import CAMERA, SIZE, frames_of

from mappo_unity.cli import play_main
from mappo_unity.config.schema import (
    CollectConfig,
    Config,
    EnvConfig,
    LogConfig,
    ModelConfig,
    PlayConfig,
    PPOConfig,
)
from mappo_unity.errors import ConfigError
from mappo_unity.policies.onnx_policy import OnnxFolder
from mappo_unity.policies.policy import RandomPolicy
from mappo_unity.protocol.demos.reader import read_demo
from mappo_unity.runs import folder as runs
from mappo_unity.scenes.core.shapes import RED, ball
from mappo_unity.scenes.registry import drawing_of
from mappo_unity.viewing.play import Pace, open_scene, play, policy_of
from mappo_unity.viewing.window import Window


def test_videos_run_at_the_pace_of_their_scene() -> None:
    pace = Pace(drawing_of("3DBall"), seconds=4)  # ticks of 0.02 s, two a frame
    assert (pace.ticks, pace.fps, pace.frames) == (2, pytest.approx(25), 100)
    pace = Pace(drawing_of("Basic"), seconds=3)  # Unity plays Basic at 0.15 s a decision
    assert (pace.ticks, pace.fps, pace.frames) == (1, pytest.approx(1 / 0.15), 20)


def test_random_actions_are_shown(tmp_path: Path, needs_video: None) -> None:
    video = tmp_path / "basic.mp4"
    shown = play(PlayConfig(env="Basic", video=str(video), seconds=6, width=96, height=64))
    assert shown["scene"] == "Basic" and shown["policy"] == "random" and shown["frames"] == 40
    assert shown["episodes"] >= 1 and -1 < shown["mean_return"] <= 0.93
    assert len(frames_of(video)) == 40


def test_videos_have_a_caption_unless_it_is_unwanted(tmp_path: Path, needs_video: None) -> None:
    frames = {}
    for caption in (True, False):
        video = tmp_path / f"{caption}.gif"
        play(PlayConfig(env="Basic", video=str(video), seconds=0.5, width=160, height=96, caption=caption))
        frames[caption] = np.stack(frames_of(video)).astype(int)
    dark, sky = (frames[caption][:, -20:].mean() for caption in (True, False))
    assert dark < 0.6 * sky
    assert np.abs(frames[True][:, :70] - frames[False][:, :70]).mean() < 3  # a GIF's own choice of colours


def test_a_run_is_shown_from_the_command_line(
    tmp_path: Path, needs_video: None, capsys: pytest.CaptureFixture[str]
) -> None:
    cfg = Config(
        env=EnvConfig(num_areas=2),
        model=ModelConfig(hidden=[8]),
        ppo=PPOConfig(minibatch_size=16),
        collect=CollectConfig(rounds=8),
        log=LogConfig(loggers=[], progress=False),
        max_steps=16,
    )
    run = tmp_path / "run"
    run.mkdir()
    runs.write_record(run, cfg, [])
    train = importlib.import_module("mappo_unity.training.trainer").train
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


def test_what_is_played_is_recorded_and_needs_no_display(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    file = tmp_path / "run.demo"
    assert play_main(["env=Basic", f"record={file}", "seconds=9", "seed=3"]) == 0
    demo = read_demo(file)
    said = f"{file}: {len(demo)} decisions of {len(demo.returns)} episodes\n"
    assert said in capsys.readouterr().out and len(demo) > 50
    ended = demo.returns[:-1] if demo.interrupted[-1] else demo.returns
    assert set(np.round(ended, 6)) <= set(np.round(_returns_of_basic(len(demo)), 6))

    assert play_main(["env=Basic", f"record={file}"]) == 2
    assert f"recording {file} exists already: give another name" in capsys.readouterr().err


def _returns_of_basic(decisions: int) -> np.ndarray:
    """Return what episodes of so many decisions at most can earn: 1 or 0.1, and 0.01 less for each."""
    costs = 0.01 * np.arange(1, decisions + 1)
    return np.concatenate([1 - costs, 0.1 - costs])


def test_a_recording_that_is_interrupted_keeps_what_was_played(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def act(self: RandomPolicy, behavior: str, steps: Any, spec: Any) -> Any:
        if len(actions) == 30:
            raise KeyboardInterrupt
        actions.append(plain(self, behavior, steps, spec))
        return actions[-1]

    actions: list[Any] = []
    plain = RandomPolicy.act
    monkeypatch.setattr(RandomPolicy, "act", act)
    assert play_main(["env=Basic", f"record={tmp_path / 'run.demo'}"]) == 130
    assert "mappo-play: interrupted" in capsys.readouterr().err
    demo = read_demo(tmp_path / "run.demo")
    assert demo.discrete.tolist() == [action.discrete[0].tolist() for action in actions][: len(demo)]
    assert len(demo) in (29, 30) and demo.done[-1]
    assert [file.name for file in tmp_path.iterdir()] == ["run.demo"]


@pytest.mark.skipif("DISPLAY" not in os.environ, reason="needs a display (xvfb-run pytest ...)")
def test_a_window_shows_frames_at_their_time() -> None:
    start = time.monotonic()
    with Window(CAMERA, SIZE, fps=20, title="test") as window:
        assert all(window.show([ball((0, 0, 0), 1.0, RED)], CAMERA, ["a", f"{i} s"]) for i in range(10))
    assert time.monotonic() - start > 0.4


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ([], "neither run nor env is given"),
        (["run=a", "policy=b.onnx"], "both say who plays"),
        (["env=Basic", "width=63"], "width=63 is out of range: width must be even"),
        (["env=Basic", "seconds=0"], "seconds=0.0 is out of range"),
        (["env=Basic", "caption=perhaps"], "caption=perhaps does not fit: caption must be true or false"),
        (["env=Basic", "caption="], "caption= does not fit: caption must be true or false"),
        (["env=Basic", "video=film.avi"], "must end in one of"),
        (["env=custom", "video=film.mp4"], "env=custom needs options of an environment of your own"),
        (["env=Nope", "video=film.mp4"], "env=Nope does not exist"),
        (["run=nowhere", "video=film.mp4"], "run=nowhere does not exist"),
        (["env=Basic", "policy=none.onnx", "video=film.gif"], "policy=none.onnx does not exist"),
        (
            ["env=Basic", "policy=.", "video=film.gif"],
            "policy=. holds no policy: that folder has none of checkpoints/best.pt, "
            "checkpoints/step_*.pt, *.onnx\n",
        ),
        (["env=Basic"], "there is no display"),
        (["env=Basic", "record="], "record= is empty"),
        (
            ["env=Basic", "record=run.mp4"],
            "recording run.mp4 must end in .demo, or be a folder for NAME.demo",
        ),
        (["env=Basic", "record=no/run.demo"], "recording no/run.demo cannot be written: "),
        (
            ["env=WallJump", "record=run.demo"],
            "recording run.demo would be of several behaviors, but a file is of one: name a folder, such as "
            "run/, for SmallWallJump.demo and BigWallJump.demo",
        ),
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
