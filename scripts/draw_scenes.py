#!/usr/bin/env python3
"""Draw a picture of every embedded scene into docs/scenes/NAME.png (each below 60 kB).

    scripts/draw_scenes.py [SCENE ...] [--out docs/scenes]

Random actions for a few decisions from a fixed seed; needs Pillow and an offscreen OpenGL (README, Videos).
"""

from __future__ import annotations

import argparse
import io
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from run_script import check_names, run_script

from mappo_unity.policies.policy import RandomPolicy
from mappo_unity.scenes import make_scene
from mappo_unity.scenes.registry import BUILT_IN, drawing_of
from mappo_unity.viewing.render import Renderer

SIZE = (720, 408)  # the shape of a video
LARGEST = 60_000  # bytes


def played(name: str) -> Any:
    """Return one area of a scene after its moment."""
    seed, decisions = BUILT_IN[name].picture
    scene: Any = make_scene(name, seed=seed, num_areas=1)
    policy = RandomPolicy(seed)
    scene.reset()
    if name == "Pyramids":  # chance presses the switch too seldom
        scene.switch_on[:] = True
        scene.bricks.appear(np.array([0]), scene.brick_spot[:1])
    for _ in range(decisions):
        for behavior, spec in scene.behavior_specs.items():
            steps, _ = scene.get_steps(behavior)
            if len(steps):
                scene.set_actions(behavior, policy.act(behavior, steps, spec))
        scene.step()
    return scene


def picture(name: str) -> np.ndarray:
    """Return the picture uint8 [height, width, 3] of a scene."""
    scene, drawing = played(name), drawing_of(name)
    camera = drawing.view(scene, 0)
    renderer = Renderer(camera, *SIZE)
    try:
        return renderer.frame(drawing.shapes(scene, 0), camera)
    finally:
        renderer.close()
        scene.close()


def compressed(pixels: np.ndarray) -> bytes:
    """Return a PNG of at most `LARGEST` bytes, with as many colours as that allows."""
    for colors in (256, 128, 64, 32, 16):
        file = io.BytesIO()
        image = Image.fromarray(pixels).quantize(colors, dither=Image.Dither.NONE)
        image.save(file, "PNG", optimize=True)
        if file.tell() <= LARGEST:
            return file.getvalue()
    raise ValueError(f"a picture of {pixels.shape} does not fit into {LARGEST} bytes")


def main() -> None:
    """Draw the pictures."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenes", nargs="*", default=list(BUILT_IN), help="default: all")
    default = Path(__file__).resolve().parents[1] / "docs" / "scenes"
    parser.add_argument("--out", type=Path, default=default)
    options = parser.parse_args()
    check_names(options.scenes, BUILT_IN, "scene")
    options.out.mkdir(parents=True, exist_ok=True)
    for name in options.scenes:
        data = compressed(picture(name))
        (options.out / f"{name}.png").write_bytes(data)
        print(f"{options.out / name}.png: {len(data):,} bytes")


if __name__ == "__main__":
    run_script(main)
