#!/usr/bin/env python3
"""Clone recordings and play the clones in the embedded scenes.

Unity's recordings of the real scenes (FOLDER holds Expert3DBall.demo, ExpertBasic.demo ...) are learnt from
alone (`bc.only=true`), and the clones are evaluated here: a good one is a proof of the scene, too. Printed is
a line for each scene and seed: the recording's decisions, its mean return (of episodes that ended; for one
that did not, what was earned until then) and the clone's, sampled, with its standard error.

    python scripts/clone_demos.py FOLDER [--scenes 3DBall Basic Hallway Pyramids PushBlock] [--seeds 0]
        [--episodes 100]
"""

from __future__ import annotations

import argparse
import os
import subprocess
import tempfile
from pathlib import Path

from learn_scene import HERE, mappo_eval
from run_script import positive, run_script

from mappo_unity.protocol.demos.reader import read_demo

AS_SEEN = "model.memory=none", "model.normalize_obs=false"  # less to know by heart in ten episodes
DEMOS = {
    "3DBall": ("Expert3DBall", ["max_steps=60000", "ppo.lr=1e-3"]),
    "Basic": ("ExpertBasic", ["max_steps=20000", "ppo.lr=1e-3"]),
    "Hallway": ("ExpertHallway", ["max_steps=100000", "ppo.lr=2e-3"]),
    "Pyramids": ("ExpertPyramid", ["max_steps=100000", "ppo.lr=1e-3", "model.hidden=[128,128]", *AS_SEEN]),
    "PushBlock": ("ExpertPushBlock", ["max_steps=100000", "ppo.lr=1e-3"]),
}
RECORDED_AS = {"PushBlock": ["env.params.gravity=9.81"]}
"""Where a recording says that the scene was another one then (docs/scenes)."""


def main() -> None:
    """Clone and evaluate every recording."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--scenes", nargs="+", choices=DEMOS, default=list(DEMOS))
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--episodes", type=positive, default=100)
    arguments = parser.parse_args()

    print(f"load average {os.getloadavg()[0]:.2f}, {os.cpu_count()} cores", flush=True)
    for scene in arguments.scenes:
        name, options = DEMOS[scene]
        demo = read_demo(arguments.folder / f"{name}.demo")
        whole = demo.returns[: int(demo.done.sum())]
        recorded = (whole if len(whole) else demo.returns).mean()
        print(f"{scene}: {len(demo)} decisions recorded, mean return {recorded:.2f}")

        for seed in arguments.seeds:
            with tempfile.TemporaryDirectory() as out:
                clone(scene, Path(demo.source), Path(out, "run"), [f"seed={seed}", *options])
                earned, error = evaluate(Path(out, "run"), arguments.episodes, RECORDED_AS.get(scene, []))
            share = f", {earned / recorded:.0%} of the recording's" if len(whole) else ""
            print(
                f"  clone, seed {seed}: {earned:.2f} +- {error:.2f} ({arguments.episodes} episodes){share}",
                flush=True,
            )


def clone(scene: str, demo: Path, folder: Path, options: list[str]) -> None:
    """Learn from a recording alone."""
    lines = [f"env={scene}", "bc.only=true", f"bc.demos=['{demo.absolute()}']", f"hydra.run.dir={folder}"]
    lines += ["collect.batch_size=2000", "ppo.minibatch_size=256", "log.progress=false", *options]
    subprocess.run([HERE / "mappo-train", *lines], check=True, stdout=subprocess.DEVNULL)


def evaluate(folder: Path, episodes: int, options: list[str]) -> tuple[float, float]:
    """Return the mean return of a run's best checkpoint, and its standard error."""
    result = mappo_eval(f"run={folder}", f"episodes={episodes}", *options)
    return result["mean_return"], result["stderr"]


if __name__ == "__main__":
    run_script(main)
