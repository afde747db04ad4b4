"""The camera of a video, from frame to frame: it stands still, or follows an agent smoothly."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from mappo_unity.scenes.core.scene import Scene
from mappo_unity.scenes.core.shapes import Camera, Drawing, Follow

LAG_S = 0.4
"""How long the camera takes for two thirds of the way to where it belongs."""


class MovingCamera:
    """Show the first area; follow its first agent where the drawing says so.

    Args:
        scene: what is shown.
        drawing: how it looks.
        frame_s: seconds between two frames.
    """

    def __init__(self, scene: Scene, drawing: Drawing, frame_s: float) -> None:
        self._scene, self._drawing = scene, drawing
        self._share = 1 - math.exp(-frame_s / LAG_S)
        self._target: np.ndarray | None = None
        self._steps = 0

    def view(self) -> Camera:
        """Return the view of the next frame."""
        wanted = self._drawing.view(self._scene, 0)
        if not isinstance(self._drawing.camera, Follow):
            return wanted

        # A new episode begins elsewhere: cut to it. What lies between the two places is no part of the story.
        steps, goal = int(self._scene.agents.step_count[0]), np.array(wanted.target)
        if self._target is None or steps < self._steps:
            self._target = goal
        else:
            self._target = self._target + self._share * (goal - self._target)
        self._steps = steps
        return replace(wanted, target=tuple(self._target.tolist()))
