#!/usr/bin/env python3
"""Film the policies of the zoo into docs/scenes/NAME.gif, each of at most 850 kB.

    python scripts/film_zoo.py [SCENE ...]

Some seconds of one area from a fixed seed, by mappo-play; needs the extra [video]. A film that is too large
is taken again, smaller or shorter.
"""

from __future__ import annotations

import argparse
import subprocess
from pathlib import Path

from learn_scene import HERE
from run_script import check_names, run_script
from score_table import has_policies

from mappo_unity.policies.policy_files import ZOO_FOLDER
from mappo_unity.scenes.registry import BUILT_IN

SIZES = ((384, 6), (320, 6), (272, 6), (240, 6), (208, 6), (240, 4))
"""Widths, in the shape of docs/scenes/NAME.png, and seconds."""
SIZES_OF = {"Pyramids": ((184, 8), (176, 8))}  # its episodes are longer
LARGEST = 850_000  # bytes
SEEDS = {"CooperativePushBlock": 10, "DungeonEscape": 3, "Pyramids": 45, "SoccerTwos": 9}
"""Of the scenes, 1 for all others. In their order: three agents push a very large block home, two groups
escape, the goal is touched, two goals are scored."""
PLACE = Path(__file__).resolve().parents[1] / "docs/scenes"


def main() -> None:
    """Film the scenes that are named, or all of which the zoo has every policy."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenes", nargs="*")
    scenes = parser.parse_args().scenes or [name for name in BUILT_IN if has_policies(ZOO_FOLDER, name)]
    check_names(scenes, BUILT_IN, "scene")

    for scene in scenes:
        path = PLACE / f"{scene}.gif"
        for width, seconds in SIZES_OF.get(scene, SIZES):
            height = round(width * 17 / 30 / 2) * 2
            size = [f"width={width}", f"height={height}", f"seconds={seconds}", f"seed={SEEDS.get(scene, 1)}"]
            lines = [f"env={scene}", "policy=zoo", f"video={path}", *size]
            subprocess.run([HERE / "mappo-play", *lines], check=True)
            if path.stat().st_size <= LARGEST:
                break
        print(f"{path.name}: {width} x {height}, {seconds} s, {path.stat().st_size:,} bytes")


if __name__ == "__main__":
    run_script(main)
