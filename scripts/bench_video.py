#!/usr/bin/env python3
"""Measure what a video costs: processor time (user + system, ffmpeg included) of mappo-play video=FILE.

    scripts/bench_video.py [SCENE ...] [--seconds 4] [--width 960] [--height 544] [--repeats 3]
                           [--beside CHECKOUT]

Random actions. Each figure is the least of the repeats; `start-up` is the cost of a video of one frame, and
`per video second` leaves it out. With --beside another checkout of the project makes the same videos in turn
with this one, and the last column is the ratio of the whole processor time: this one's part of the other's.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

from run_script import positive, run_script

HERE = Path(__file__).resolve().parents[1]
CODE = "import sys; from mappo_unity.cli import play_main; sys.exit(play_main(sys.argv[1:]))"


class Cost(NamedTuple):
    """What a video took."""

    frames: int
    bytes: int
    start_s: float
    """Processor time of a video of one frame."""
    total_s: float
    """Processor time of the whole video."""


def make_video(checkout: Path, scene: str, seconds: float, width: int, height: int) -> tuple[int, int, float]:
    """Make a video by the code of `checkout`; return frames, bytes and processor seconds."""
    threads = {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    with tempfile.TemporaryDirectory() as folder:
        video = Path(folder) / "video.mp4"
        options = [
            f"env={scene}",
            f"video={video}",
            f"seconds={seconds}",
            f"width={width}",
            f"height={height}",
        ]

        before = os.times()
        run = subprocess.run(
            [sys.executable, "-c", CODE, *options],
            cwd=checkout,
            env=os.environ | threads | {"PYTHONPATH": str(checkout)},
            capture_output=True,
            text=True,
        )
        after = os.times()
        run.check_returncode()

        frames = re.search(r"(\d+) frames", run.stdout)
        assert frames, run.stdout
        cost_s = after.children_user + after.children_system - before.children_user - before.children_system
        return int(frames[1]), video.stat().st_size, cost_s


def least(repeats: list[Cost]) -> Cost:
    """Return the repeat's figures with the least times."""
    return repeats[0]._replace(
        start_s=min(cost.start_s for cost in repeats), total_s=min(cost.total_s for cost in repeats)
    )


def main() -> None:
    """Make the videos and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenes", nargs="*", default=["3DBall", "Pyramids", "SoccerTwos", "Walker"])
    parser.add_argument("--seconds", type=float, default=4.0, help="length of the videos")
    parser.add_argument("--width", type=positive, default=960)
    parser.add_argument("--height", type=positive, default=544)
    parser.add_argument("--repeats", type=positive, default=3)
    parser.add_argument("--beside", type=Path, help="another checkout, to compare with")
    options = parser.parse_args()
    size = options.width, options.height
    checkouts = [HERE] if options.beside is None else [options.beside.resolve(), HERE]

    print(f"{options.seconds:g} s of {size[0]}x{size[1]}, processor seconds (user + system), ffmpeg included")
    print(
        f"{'scene':18} {'':6} {'frames':>6} {'kB':>6} {'start-up':>9} {'whole':>7} {'per video second':>17}"
    )
    for scene in options.scenes:
        costs: list[list[Cost]] = [[] for _ in checkouts]
        for _ in range(options.repeats):
            for mine, checkout in zip(costs, checkouts, strict=True):  # in turn: a busy machine slows both
                start_s = make_video(checkout, scene, 1e-3, *size)[2]
                frames, size_bytes, total_s = make_video(checkout, scene, options.seconds, *size)
                mine.append(Cost(frames, size_bytes, start_s, total_s))
        found = [least(mine) for mine in costs]
        for cost, label in zip(found, ["other", "this"][-len(found) :], strict=True):
            each_s = (cost.total_s - cost.start_s) / options.seconds
            line = f"{scene:18} {label:6} {cost.frames:6} {cost.bytes / 1000:6.0f} {cost.start_s:9.2f} "
            line += f"{cost.total_s:7.2f} {each_s:17.2f}"
            if len(found) == 2 and label == "this":
                line += f"   {cost.total_s / found[0].total_s:.2f} of the other"
            print(line, flush=True)


if __name__ == "__main__":
    run_script(main)
