#!/usr/bin/env python3
"""Race the presets against the official mlagents-learn: the same minutes, the same machine, in turns.

Three train a scene, one after the other, each for MINUTES of wall-clock, its start included: mlagents-learn
with the official configuration through mappo-player, our preset through the same player, and our preset with
the scene embedded. A run that ends by itself (max_steps) is over earlier. Returns through the player are
those that the player itself notes; embedded ones are those of metrics.csv. Where teams play against each
other no return tells who plays well: what each has saved then plays matches, against random players and
against what mlagents-learn has saved. With --patience it trains on for so many times the minutes (not where
teams play), to show when it comes to the target; what the three earn is compared after MINUTES. With --who
only some of the three train: where teams play, that gives one of them other minutes than the others had.

    python scripts/race_peer.py --peer VENV/bin/mlagents-learn --official ml-agents/config \\
        --scenes 3DBall=3 Basic=3 [--patience 1] [--seeds 0] [--who mlagents-learn] [--out outputs/race]
    python scripts/race_peer.py --draw          # only the table docs/benchmarks/race.md and the picture

What was measured stands in docs/benchmarks/race.csv and race_matches.csv, and is not run again.
"""

from __future__ import annotations

import argparse
import math
import os
import shutil
import signal
import statistics
import subprocess
import time
from pathlib import Path
from typing import Any

from learn_scene import HERE, append, mappo_eval, read_rows, thin
from peer_command import add_peer_options, check_peer_options, their_command
from race_page import EMBEDDED, MATCHES, NAMES, PEER, PLAYER, RACE, TARGETS, WINDOW, write_page
from recorded_player import EPISODES, make_player, noted
from run_script import run_script
from score_measures import share_won

from mappo_unity.runs.metrics_csv import read_metrics

POINTS = 60  # of a curve
COMPETITIVE = ("SoccerTwos",)
NOT_RACED = ("StrikersVsGoalie",)  # no return tells who plays well, and each side is a file of its own
NUM_MATCHES = 400
DONE = "trained"  # the file that says so, in a folder whose matches are not all in the table


def main() -> None:
    """Run what is missing, then write the page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add_peer_options(parser)
    parser.add_argument("--scenes", type=minutes_of, nargs="+", default=[], metavar="SCENE=MINUTES")
    parser.add_argument(
        "--patience", type=patience_of, default=1.0, help="how many times MINUTES mlagents-learn gets"
    )
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--who", nargs="+", choices=NAMES, default=NAMES, help="who trains")
    parser.add_argument("--out", type=Path, default=Path("outputs/race"))
    arguments = parser.parse_args()
    if arguments.scenes:
        check_peer_options(arguments, [scene for scene, _ in arguments.scenes])

    for scene, minutes in [] if arguments.draw else arguments.scenes:
        for seed in arguments.seeds:
            # who begins changes, as the machine's load does
            order = [PEER, PLAYER, EMBEDDED] if seed % 2 == 0 else [EMBEDDED, PLAYER, PEER]
            for who in (name for name in order if name in arguments.who):
                waits = who == PEER and scene not in COMPETITIVE  # matches are of what the same minutes gave
                race(arguments, scene, seed, who, 60 * minutes * (arguments.patience if waits else 1))
            if scene in COMPETITIVE:
                play_matches(arguments, scene, seed, minutes)

    write_page()


def minutes_of(word: str) -> tuple[str, float]:
    """Return the scene and the minutes of SCENE=MINUTES; raises ArgumentTypeError."""
    scene, _, minutes = word.partition("=")
    number = _number(minutes)
    if not 0 < number < math.inf:
        raise argparse.ArgumentTypeError(f"{word} must be SCENE=MINUTES, such as 3DBall=3")
    if scene in NOT_RACED:
        raise argparse.ArgumentTypeError(
            f"{scene} cannot be raced: no return tells who plays well, and each of its sides has a policy of "
            f"its own; of the scenes with two sides {', '.join(COMPETITIVE)} can be"
        )
    return scene, number


def patience_of(word: str) -> float:
    """Return how many times the minutes; raises ArgumentTypeError."""
    number = _number(word)
    if not 1 <= number < math.inf:
        raise argparse.ArgumentTypeError(f"{word} must be a number of at least 1")
    return number


def _number(word: str) -> float:
    """Return the number that a word is; nan, which no rule is kept by: it is none."""
    try:
        return float(word)
    except ValueError:
        return math.nan


def race(arguments: argparse.Namespace, scene: str, seed: int, who: str, limit_s: float) -> None:
    """Let one train for its time, unless that has been done, and append its curve."""
    if is_known(scene, seed, who, limit_s / 60):
        return
    folder = folder_of(arguments, scene, seed, who, limit_s / 60)
    if (folder / DONE).exists():  # only its matches are still to be played
        return
    shutil.rmtree(folder, ignore_errors=True)  # of a run that was cut off
    folder.mkdir(parents=True)

    command = command_of(arguments, scene, seed, who, folder)
    load, start = os.getloadavg()[0], time.time()
    seconds = run_for(command, folder / "log", limit_s)
    if scene in COMPETITIVE:
        (folder / DONE).touch()  # matches tell who plays well
        return

    points = embedded_curve(folder, start) if who == EMBEDDED else player_curve(folder, start)
    facts = {
        "limit": round(limit_s),
        "seconds": round(seconds),
        "load": f"{load:.1f}-{os.getloadavg()[0]:.1f}",
    }
    # whoever is interrupted plays on while it saves
    points = [point for point in points if point[0] <= limit_s]
    target = TARGETS.get(scene, math.inf)
    place = {"scene": scene, "who": who, "seed": seed}
    rows = [
        place | {"second": round(at_s, 1), "decisions": decisions, "return": f"{value:.4g}"} | facts
        for at_s, decisions, value in thin(points, POINTS, lambda point: point[2] >= target)
    ]
    append(RACE, *rows)
    print(scene, who, seed, facts, points[-1:], flush=True)


def is_known(scene: str, seed: int, who: str, minutes: float) -> bool:
    """Return whether what one of the three came to stands in a file: its curve, or matches after minutes."""
    rows = [row for row in read_rows(MATCHES) if float(row["minutes"]) == minutes]
    rows += read_rows(RACE)
    return any((row["scene"], int(row["seed"]), row["who"]) == (scene, seed, who) for row in rows)


def folder_of(arguments: argparse.Namespace, scene: str, seed: int, who: str, minutes: float) -> Path:
    """Return where one of the three trains for its minutes."""
    out: Path = arguments.out
    return out.resolve() / f"{scene}-{who.replace(' ', '_')}-{seed}-{minutes:g}"


def play_matches(arguments: argparse.Namespace, scene: str, seed: int, minutes: float) -> None:
    """Let what was saved after the minutes play; append a row for each opponent, unless it stands."""
    facts = ("scene", "seed", "who", "against", "minutes")
    known = {tuple(row[fact] for fact in facts) for row in read_rows(MATCHES)}
    theirs = folder_of(arguments, scene, seed, PEER, minutes) / "run" / f"{scene}.onnx"

    for who, against in (
        (PEER, "random"),
        (PLAYER, "random"),
        (PLAYER, PEER),
        (EMBEDDED, "random"),
        (EMBEDDED, PEER),
    ):
        # with --who there may be nobody to play, or to play against
        there = who in arguments.who and (against == "random" or against in arguments.who)
        if not there or (scene, str(seed), who, against, f"{minutes:g}") in known:
            continue

        folder = folder_of(arguments, scene, seed, who, minutes)
        policy = theirs if who == PEER else folder / "run"
        opponent = theirs if against == PEER else against
        words = f"run={policy}", f"env={scene}", f"opponent={opponent}", f"episodes={NUM_MATCHES}"
        won, stderr = share_won(mappo_eval(*words, "deterministic=false"))

        row = {
            "scene": scene,
            "seed": seed,
            "who": who,
            "against": against,
            "won": f"{won:.4g}",
            "stderr": f"{stderr:.2g}",
            "matches": NUM_MATCHES,
            "decisions": decisions_of(folder),
            "minutes": f"{minutes:g}",
        }
        append(MATCHES, row)
        print(row, flush=True)

    for who in arguments.who:  # rows that are taken out of the table are trained for anew
        (folder_of(arguments, scene, seed, who, minutes) / DONE).unlink(missing_ok=True)


def decisions_of(folder: Path) -> int:
    """Return how many decisions a run made: by its own metrics, or those that its player was asked for."""
    path = folder / "run/metrics.csv"
    if path.exists():
        return int(read_metrics(path)[-1]["agent_steps"])
    return noted(folder / EPISODES)[-1][0]


def command_of(arguments: argparse.Namespace, scene: str, seed: int, who: str, folder: Path) -> list[Any]:
    """Return the command line of one of the three."""
    if who == PEER:
        return their_command(arguments, scene, seed, None, make_player(scene, folder), folder)

    lines = [f"env={scene}", f"seed={seed}", "num_threads=1", f"hydra.run.dir={folder / 'run'}"]
    if who == PLAYER:
        player = make_player(scene, folder)
        lines += [
            "env.backend=player",
            f"env.file_name={player}",
            "env.no_graphics=true",
        ]
    return [HERE / "mappo-train", *lines, "log.progress=false"]


def run_for(command: list[Any], log: Path, limit_s: float) -> float:
    """Run a command for so long, then interrupt it; return the seconds that it had."""
    environment = os.environ | {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
    start = time.monotonic()

    with open(log, "w") as file:
        process = subprocess.Popen(
            list(map(str, command)),
            stdout=file,
            stderr=subprocess.STDOUT,
            env=environment,
            start_new_session=True,
            preexec_fn=heed_interrupts,
        )
        try:
            code = process.wait(limit_s)
        except subprocess.TimeoutExpired:
            interrupt(process)
            return limit_s
        except BaseException:  # its session is its own: a Ctrl-C does not reach it
            interrupt(process)
            raise

    if code:
        raise SystemExit(f"exit code {code}; the end of {log} says why")
    return time.monotonic() - start


def interrupt(process: subprocess.Popen) -> None:
    """End a process as Ctrl-C does, and all of its group where that takes more than a minute."""
    process.send_signal(signal.SIGINT)
    try:
        process.wait(60)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def heed_interrupts() -> None:
    """Take SIGINT again: a job in the background, as this script may be one, passes on that it is ignored."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def player_curve(folder: Path, start: float) -> list[tuple[float, int, float]]:
    """Return (seconds, decisions, mean return of the newest episodes) from what the player noted."""
    episodes = noted(folder / EPISODES)
    points = []
    for i in range(WINDOW - 1, len(episodes), WINDOW // 4):
        mean = statistics.mean(value for _, value, _ in episodes[i - WINDOW + 1 : i + 1])
        decisions, _, at_s = episodes[i]
        points.append((at_s - start, decisions, mean))
    return points


def embedded_curve(folder: Path, start: float) -> list[tuple[float, int, float]]:
    """Return the same from metrics.csv, with the times at which TensorBoard's file noted the rows."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    rows = [row for row in read_metrics(folder / "run/metrics.csv") if row["episodes"] >= WINDOW]
    events = EventAccumulator(str(folder / "run/tensorboard"), size_guidance={"scalars": 0})  # 0: all
    events.Reload()
    noted = {event.step: event.wall_time for event in events.Scalars("return_mean")}
    return [
        (noted[int(row["agent_steps"])] - start, int(row["agent_steps"]), row["return_mean"]) for row in rows
    ]


if __name__ == "__main__":
    run_script(main)
