#!/usr/bin/env python3
"""Put the best policies of runs into the zoo that the package brings, with a card for each.

Exports the best checkpoint of every RUN to mappo_unity/zoo/BEHAVIOR.onnx, in place of an older one, plays
what was written, and rewrites zoo.csv and README.md there: how each was trained, what it earns.

    python scripts/make_zoo.py RUN ... [--episodes N]
"""

from __future__ import annotations

import argparse
import csv
import tempfile
import time
from pathlib import Path
from typing import Any

from learn_scene import mappo_eval, read_rows
from omegaconf import OmegaConf
from run_script import positive, run_script
from score_measures import measures_of

from mappo_unity.config.compose import compose_config, load_config
from mappo_unity.diagnosis.evidence import amount
from mappo_unity.policies.export import export_checkpoint
from mappo_unity.policies.policy_files import ZOO_FOLDER, choose_checkpoint
from mappo_unity.runs.metrics_csv import read_metrics

CARDS = ZOO_FOLDER / "zoo.csv"
LARGEST_BYTES = 1_500_000
FILES = "recipe", "parameters", "--config"
"""What chooses a file of options: config.yaml keeps those, but not its name."""

HEAD = """\
# Zoo

Small trained policies, one ONNX file a behavior, that come with the package: `policy=zoo`,
`run=zoo` and `opponent=zoo` play them, and Unity loads them. All were trained by this project in
its embedded scenes with the preset of the scene and the options in the table, and are under its
license. *Earns* is what the file itself earned in 400 episodes (WallJump: 2,000) as
`mappo-eval run=zoo env=SCENE` plays it (two-sided scenes: share won of the decided matches against
a random side).

Written by `scripts/make_zoo.py`: change nothing here by hand.

| behavior | scene | earns | seed | decisions | options | file | date |
|---|---|---|---|---|---|---|---|
"""


def main() -> None:
    """Export, measure, and write the cards."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("runs", nargs="*", type=Path, metavar="RUN")
    parser.add_argument("--episodes", type=positive, help="instead of the score table's")
    arguments = parser.parse_args()

    cards = {card["behavior"]: card for card in read_rows(CARDS)}
    for run in arguments.runs:
        cards |= {card["behavior"]: card for card in add(run, arguments.episodes)}
        write(sorted(cards.values(), key=lambda card: (card["scene"], card["behavior"])))


def add(run: Path, episodes: int | None) -> list[dict[str, Any]]:
    """Put the policies of a run into the zoo; return their cards."""
    config = load_config(run / "config.yaml")
    scene = str(config.env.name)
    episodes = episodes or measures_of(scene)[0].episodes

    # what the zoo holds is replaced by what has been measured, and by nothing else
    with tempfile.TemporaryDirectory(dir=ZOO_FOLDER.parent) as folder:
        exported = export_checkpoint(choose_checkpoint(run), Path(folder))
        sizes = {file.policy: file.path.stat().st_size for file in exported}
        for policy, size in sizes.items():
            if size > LARGEST_BYTES:
                raise SystemExit(f"{policy} has {size:,} bytes: at most {LARGEST_BYTES:,}")

        said = mappo_eval(f"run={folder}", f"env={scene}", f"episodes={episodes}", *opponent(run))
        for file in exported:
            file.path.replace(ZOO_FOLDER / file.path.name)

    return [
        {
            "behavior": file.policy,
            "scene": scene,
            "earns": earned(said, file.policy),
            "seed": config.seed,
            "decisions": file.agent_steps,
            "options": " ".join(beyond_preset(given(run), run)),
            "bytes": sizes[file.policy],
            "date": time.strftime("%Y-%m-%d"),
        }
        for file in exported
    ]


def opponent(run: Path) -> list[str]:
    """Return the option that makes matches of the episodes, in scenes with two sides."""
    # the row after the last series has none of its figures
    played = any("win_rate_vs_random" in row for row in read_metrics(run / "metrics.csv"))
    return ["opponent=random"] if played else []


def given(run: Path) -> list[str]:
    """Return the options of a run, as they were given last; those that say where it lies are left out."""
    import yaml

    saved = yaml.safe_load((run / "overrides.yaml").read_text())
    places = "env=", "seed=", "hydra.", "output_dir=", "resume="
    lines = [line for entry in saved for line in entry["overrides"] if not line.startswith(places)]
    return list({line.partition("=")[0]: line for line in lines}.values())


def beyond_preset(lines: list[str], run: Path) -> list[str]:
    """Return the options of a run without those that the preset of its scene has, too."""
    own = compose_config([], run / "config.yaml").tree
    preset = compose_config([f"env={own.env.name}"]).tree

    def is_own(line: str) -> bool:
        name, _, value = line.partition("=")
        if name in FILES:
            return value not in ("none", "null")
        return bool(OmegaConf.select(own, name) != OmegaConf.select(preset, name))

    return [line for line in lines if is_own(line)]


def earned(said: dict[str, Any], behavior: str) -> str:
    """Return what a behavior earned, as the card says it."""
    if "won_of_decided" in said:
        return f"{100 * said['won_of_decided']:.1f} % of {said['wins'] + said['losses']} matches"
    own = said
    if "behaviors" in said:
        own = next(value for name, value in said["behaviors"].items() if name.split("?")[0] == behavior)
    value = own.get("mean_group_return") or own["mean_return"]
    error = float(f"{own['stderr']:.1g}")  # one digit of it
    return f"{amount(value)} +- {amount(error)}"


def write(cards: list[dict[str, Any]]) -> None:
    """Write the cards, for programs and for people."""
    with open(CARDS, "w", newline="") as file:
        writer = csv.DictWriter(file, list(cards[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(cards)

    lines = []
    for card in cards:
        options = f"`{card['options']}`" if card["options"] else "none"
        kilobytes = f"{int(card['bytes']) / 1000:.0f} kB"
        cells = card["behavior"], card["scene"], card["earns"], card["seed"], f"{int(card['decisions']):,}"
        lines.append(f"| {' | '.join(map(str, cells))} | {options} | {kilobytes} | {card['date']} |")
    (ZOO_FOLDER / "README.md").write_text(HEAD + "\n".join(lines) + "\n")


if __name__ == "__main__":
    run_script(main)
