"""What mappo-play does: show a policy in its embedded scene, in a video or a window, or record it."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager, ExitStack, nullcontext
from pathlib import Path
from typing import Any, Protocol

import torch
from mlagents_envs.base_env import BaseEnv

from mappo_unity.config.schema import PlayConfig
from mappo_unity.policies.evaluate import open_policy
from mappo_unity.policies.first_checks import check_embedded
from mappo_unity.policies.policy import Policy
from mappo_unity.policies.policy_files import at_its_lessons
from mappo_unity.protocol.demos.recording_env import RecordingEnv
from mappo_unity.runs.options import config_to_play
from mappo_unity.scenes.core.scene import Scene
from mappo_unity.scenes.core.shapes import Camera, Drawing, Follow, Shape
from mappo_unity.scenes.registry import drawing_of, make_scene
from mappo_unity.signals import termination_as_interrupt
from mappo_unity.viewing.camera import MovingCamera
from mappo_unity.viewing.caption import Tally
from mappo_unity.viewing.video import VideoFile, check_video
from mappo_unity.viewing.window import Window

FRAMES_PER_S = 30  # about: a frame shows a whole number of ticks
RANDOM = "random"


class Screen(Protocol):
    """What shows frames: a video file, a window, or nothing."""

    def show(self, shapes: Sequence[Shape], camera: Camera, caption: Sequence[str] = ()) -> bool:
        """Show a frame, with a line of text unless it is empty; return whether another one is wanted."""
        ...


class Unseen:
    """Show nothing, and want more."""

    def show(self, shapes: Sequence[Shape], camera: Camera, caption: Sequence[str] = ()) -> bool:
        """Return True."""
        return True


def play(cfg: PlayConfig) -> dict[str, Any]:
    """Show a policy in one area of its scene for `cfg.seconds`.

    Returns:
        Scene, policy, seconds and frames shown, the agent episodes that ended with their mean return, and
        what was recorded.

    Raises:
        ConfigError: no scene of ours, no policy that fits it, no way to draw or to write the file.
        Interrupted: SIGTERM came; as after Ctrl-C, nothing of the video is left, and what was recorded is.
    """
    video = Path(cfg.video) if cfg.video else None
    if video is not None:
        check_video(video, cfg.caption)

    torch.set_num_threads(1)
    torch.manual_seed(cfg.seed)

    with ExitStack() as stack:
        scene = open_scene(cfg)
        stack.callback(scene.close)
        policy = policy_of(cfg, scene)
        recording = RecordingEnv(scene, cfg.record) if cfg.record is not None else None
        if recording is not None:
            stack.callback(recording.close)
        if video is not None or recording is not None:
            stack.enter_context(termination_as_interrupt())

        drawing = drawing_of(scene.NAME)
        pace = Pace(drawing, cfg.seconds)
        screen = stack.enter_context(_screen(cfg, scene, drawing, pace.fps))
        figures = _roll(recording or scene, policy, Projector(scene, drawing, pace, screen, cfg.caption))

    head = {"scene": scene.NAME, "policy": cfg.run or cfg.policy or RANDOM, "video": cfg.video}
    return head | figures | {"recorded": [] if recording is None else recording.recorded}


def _screen(cfg: PlayConfig, scene: Scene, drawing: Drawing, fps: float) -> AbstractContextManager[Screen]:
    """Return what shows the frames, a context manager."""
    first, size = drawing.view(scene, 0), (cfg.width, cfg.height)
    if cfg.video is not None:
        return VideoFile(Path(cfg.video), first, size, fps)
    if cfg.record is not None:
        return nullcontext(Unseen())
    return Window(first, size, fps, f"mappo-play {scene.NAME}")


def open_scene(cfg: PlayConfig) -> Scene:
    """Open one area of the scene that a run was trained in, or that `cfg.env` names."""
    options = config_to_play(Path(cfg.run or ""), cfg.env).env
    check_embedded(options)
    options = at_its_lessons(options, cfg.run or cfg.policy or RANDOM)
    return make_scene(options.name, seed=cfg.seed, **{**options.parameters, "num_areas": 1})


def policy_of(cfg: PlayConfig, scene: Scene) -> Policy:
    """Return the policy, checked against every behavior."""
    policy = open_policy(
        cfg.run or cfg.policy or RANDOM, cfg.deterministic, cfg.seed, "run" if cfg.run else "policy"
    )

    for name, spec in scene.behavior_specs.items():
        policy.check(name, spec)
    return policy


class Pace:
    """How many ticks a frame shows, frames a second, and frames in all."""

    def __init__(self, drawing: Drawing, seconds: float) -> None:
        self.ticks = max(1, round(1 / (FRAMES_PER_S * drawing.tick_s)))
        self.fps = 1 / (self.ticks * drawing.tick_s)
        self.frames = max(1, round(seconds * self.fps))


class Projector:
    """Show a scene on a screen, every few ticks, until the video is over."""

    def __init__(self, scene: Scene, drawing: Drawing, pace: Pace, screen: Screen, caption: bool) -> None:
        self.scene, self.drawing, self.pace, self.screen = scene, drawing, pace, screen
        self.ticks = self.frames = 0
        self.over = False

        followed = int(scene.agents.agent_id[0]) if isinstance(drawing.camera, Follow) else None
        self.tally = Tally(drawing.goals, followed)
        self._camera = MovingCamera(scene, drawing, 1 / pace.fps)
        self._caption = caption

    def tick(self) -> None:
        """Show the scene if a frame is due."""
        self.ticks += 1
        # A step of the scene has several ticks: the video may be over before it ends.
        if self.over or self.ticks % self.pace.ticks:
            return

        time = f"{self.ticks * self.drawing.tick_s:.1f} s"
        caption = [self.scene.NAME, time, *self.tally.score()] if self._caption else []
        wanted = self.screen.show(self.drawing.shapes(self.scene, 0), self._camera.view(), caption)

        self.frames += 1
        self.over = not wanted or self.frames >= self.pace.frames


def _roll(env: BaseEnv, policy: Policy, projector: Projector) -> dict[str, Any]:
    """Play the projector's scene, of which `env` hands calls on, until the video is over."""
    projector.scene.after_tick = projector.tick
    env.reset()

    # Frames are shown by `tick`, from within the steps of the scene.
    while not projector.over:
        steps = {name: env.get_steps(name) for name in env.behavior_specs}
        for name, begun in projector.tally.add(steps).items():
            policy.end(name, steps[name][1].agent_id.tolist())
            policy.forget(name, begun)
            decisions, spec = steps[name][0], env.behavior_specs[name]
            if len(decisions):
                env.set_actions(name, policy.act(name, decisions, spec))
        env.step()

    returns = projector.tally.returns
    return {
        "seconds": projector.frames / projector.pace.fps,
        "frames": projector.frames,
        "episodes": len(returns),
        "mean_return": sum(returns) / len(returns) if returns else None,
    }
