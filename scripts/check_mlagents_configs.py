"""Run ML-Agents' own configuration files with mappo-learn, and print what becomes of each as a table.

    python scripts/check_mlagents_configs.py ml-agents/config --demos ml-agents/Project

Two iterations of 1000 decisions in the embedded scene, where there is one; what has none is translated only.
The table says what ran, and what mappo-learn warned about or refused.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import os
import re
import tempfile
import time
from pathlib import Path

from run_script import run_script

from mappo_unity.cli import learn_main
from mappo_unity.scenes.registry import scene_names

SCENES = {
    "FoodCollector": "GridFoodCollector",
    "PushBlockCollab": "CooperativePushBlock",
    "PyramidsRND": "Pyramids",
}
BATCH = 1000
SHRUNK = [f"collect.batch_size={BATCH}", f"max_steps={2 * BATCH}", "env.num_areas=2", "matches.interval=null"]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("config", type=Path, help="the folder with ppo/, poca/, sac/ and imitation/")
    parser.add_argument(
        "--demos", type=Path, help="where .demo files are sought; without it those files fail"
    )
    parser.add_argument("--only", default="", help="part of the names of the files to run")
    arguments = parser.parse_args()

    files = sorted(arguments.config.resolve().rglob("*.yaml"))
    if not files:
        parser.error(f"{arguments.config} does not exist, or has no .yaml file")
    demos = arguments.demos.resolve() if arguments.demos else None
    print("| file | outcome | what was said |\n|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        for file in files:
            name = f"{file.parent.name}/{file.name}"
            if arguments.only in name:
                outcome, said = examine(file, demos)
                print(f"| {name} | {outcome} | {said} |", flush=True)


def examine(file: Path, demos: Path | None) -> tuple[str, str]:
    """Return how a file fared, and what mappo-learn said about it."""
    link_demos(file, demos)
    stem = file.stem.partition("_")[0]
    scene = SCENES.get(stem, stem)
    flags = [str(file), "--seed=0", f"--run-id={file.parent.name}-{file.stem}"]

    start = time.perf_counter()
    if scene in scene_names():
        code, out, errors = call([*flags, f"--env=scene:{scene}", *SHRUNK])
        iterations = len(re.findall(r"^[\d,]+/[\d,]+ steps", out, re.MULTILINE))
        outcome = f"{iterations} iterations in {scene}, {time.perf_counter() - start:.0f} s"
    else:
        code, out, errors = call([*flags, "--env=Build", "--print-options"])
        outcome = f"translated to {len(out.splitlines())} options (needs a Unity build)"

    said = [line.removeprefix("mappo-learn: ").replace(f"{file}, ", "") for line in errors.splitlines()]
    if code:
        outcome = "refused" if code == 2 else f"failed, exit code {code}"
    return outcome, "; ".join(said)


def link_demos(file: Path, demos: Path | None) -> None:
    """Let the demonstrations that a file names lie where it says."""
    for text in re.findall(r"demo_path: (\S+)", file.read_text()):
        found = next(demos.rglob(Path(text).name), None) if demos else None
        if found is not None and not Path(text).exists():
            Path(text).parent.mkdir(parents=True, exist_ok=True)
            Path(text).symlink_to(found)


def call(arguments: list[str]) -> tuple[int, str, str]:
    """Return exit code, output and errors of mappo-learn."""
    out, errors = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(errors):
        code = learn_main(arguments)
    return code, out.getvalue(), errors.getvalue()


if __name__ == "__main__":
    run_script(main)
