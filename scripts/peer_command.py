"""The official mlagents-learn as the one to compare with: what a script asks for, and its command line."""

from __future__ import annotations

import argparse
import socket
from collections.abc import Collection
from pathlib import Path
from typing import Any

import yaml
from run_script import check_names

from mappo_unity.errors import ConfigError
from mappo_unity.scenes.registry import BUILT_IN

CONFIGURATIONS = {
    "CooperativePushBlock": "PushBlockCollab",
    "GridFoodCollector": "FoodCollector",
    "Pyramids": "PyramidsRND",
}
"""Official files of another name than the scene's; of two for Pyramids the one with the preset's novelty."""


def add_peer_options(parser: argparse.ArgumentParser) -> None:
    """Add --peer, --official and --draw."""
    parser.add_argument("--peer", type=Path, help="the mlagents-learn to compare with")
    parser.add_argument("--official", type=Path, help="ML-Agents' folder config/, with ppo/ and poca/")
    parser.add_argument("--draw", action="store_true", help="run nothing")


def check_peer_options(arguments: argparse.Namespace, scenes: Collection[str]) -> None:
    """Raise ConfigError unless `scenes` can be trained by mlagents-learn, or nothing is run."""
    if arguments.draw:
        return
    if arguments.peer is None or arguments.official is None:
        raise ConfigError("--peer and --official are needed to run anything (--draw runs nothing)")

    check_names(scenes, BUILT_IN, "scene")
    for scene in scenes:
        official_file(arguments.official, scene)


def official_file(folder: Path, scene: str) -> Path:
    """Return the official configuration of a scene, in ppo/ or poca/; raises ConfigError: it is not there."""
    name = f"{CONFIGURATIONS.get(scene, scene)}.yaml"
    for path in folder.glob(f"p*/{name}"):
        return path
    raise ConfigError(f"--official={folder} has no ppo/{name} and no poca/{name}")


def their_command(
    arguments: argparse.Namespace, scene: str, seed: int, steps: int | None, player: Path, folder: Path
) -> list[Any]:
    """Return the command line of mlagents-learn, with the official configuration but for max_steps.

    `steps` takes that one's place; with None it stays, too.
    """
    configuration = yaml.safe_load(official_file(arguments.official, scene).read_text())
    for behavior in configuration["behaviors"].values() if steps is not None else ():
        behavior["max_steps"] = steps
    path = folder / "configuration.yaml"
    path.write_text(yaml.safe_dump(configuration))

    with socket.socket() as probe:  # a port that nobody uses
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    place = ["--results-dir", folder, "--run-id", "run", "--base-port", port, "--no-graphics"]
    return [*map(str, [arguments.peer, path, "--env", player, "--seed", seed, *place])]
