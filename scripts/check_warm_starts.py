#!/usr/bin/env python3
"""Make actors of the ONNX files in a folder, and compare their actions with onnxruntime's.

    python scripts/check_warm_starts.py FOLDER

A file is named after its behavior (SmallWallJump.onnx), and a scene of ours must have it. Every tensor of the
actor must come from the file. Both play the same random observations, all actions allowed; the table has the
largest difference of means (divided by 3, as ML-Agents does), log-probabilities (of larger ones of their
size) and memory, as a training run with init_from= says it. Exit code 1 if a file is refused.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from mlagents_envs.base_env import BehaviorSpec
from run_script import run_script

from mappo_unity.errors import ConfigError
from mappo_unity.keys import policy_name
from mappo_unity.policies.warm_start.actors import actor_from_onnx
from mappo_unity.policies.warm_start.agreement import TOLERANCE, check_agreement
from mappo_unity.policies.warm_start.onnx_network import read_network
from mappo_unity.policies.warm_start.start import show_options
from mappo_unity.scenes import make_scene
from mappo_unity.scenes.registry import scene_names


def main() -> int:
    """Print a row for each file; return the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    paths = sorted(parser.parse_args().folder.glob("*.onnx"))
    if not paths:
        parser.error("there is no .onnx file in that folder")

    specs, refused = behaviors_of_scenes(), 0
    print(f"| file | network | largest difference (at most {TOLERANCE:g}) |\n|---|---|---|")
    for path in paths:
        if path.stem not in specs:
            print(f"| {path.name} | no scene has this behavior | - |")
            continue
        try:
            network, error = compare(path, specs[path.stem])
        except ConfigError as mistake:
            refused += 1
            print(f"| {path.name} | refused: {mistake} | - |")
            continue
        print(f"| {path.name} | {network} | {error:.1e} |", flush=True)
    return 1 if refused else 0


def behaviors_of_scenes() -> dict[str, BehaviorSpec]:
    """Return what the behaviors of the embedded scenes observe and do, by name without its team."""
    specs: dict[str, BehaviorSpec] = {}
    for scene in scene_names():
        env = make_scene(scene, num_areas=1)
        try:
            env.reset()
            specs |= {policy_name(name): spec for name, spec in env.behavior_specs.items()}
        finally:
            env.close()
    return specs


def compare(path: Path, spec: BehaviorSpec) -> tuple[str, float]:
    """Return a file's network in words, and the largest difference of its actions to an actor's.

    Raises:
        ConfigError: a tensor does not fit, or the actions differ.
    """
    actor, network = actor_from_onnx(path, spec), read_network(path)
    sensors = [list(sensor.shape) for sensor in spec.observation_specs]
    return show_options(network.options), check_agreement(network, actor[0].module, sensors)


if __name__ == "__main__":
    run_script(main)
