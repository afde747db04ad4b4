#!/usr/bin/env python3
"""Train 3DBall while its player is killed, stopped and made to send nonsense at random moments.

Runs mappo-train on a player of its own that sends a malformed message on SIGUSR1 and NaN on SIGUSR2; prints
what was done to it, what the metrics counted, how the training ended, and what the final policy earns in
episodes of its own (those that troubles cut off do not count, and they are the long ones). Exit code 0 if it
solved 3DBall and every trouble was counted.

While troubles come every second or two, the complete episodes are those that ended early, so the policy is
judged after a second half without troubles.

    python scripts/soak_player.py [--kills 20] [--hangs 5] [--malformed 5] [--nan 2] [--max-steps 4000000]
"""

from __future__ import annotations

import argparse
import os
import random
import shlex
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

from run_script import positive, run_script

HANG_TIMEOUT_S = 5.0


def main() -> int:
    """Run the training and the disturbances; return the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--hangs", type=int, default=5)
    parser.add_argument("--malformed", type=int, default=5)
    parser.add_argument("--nan", type=int, default=2)
    parser.add_argument("--every-s", type=float, default=1.5, help="mean time between two troubles")
    parser.add_argument("--max-steps", type=positive, default=4_000_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("options", nargs="*", help="further options of mappo-train")
    arguments = parser.parse_args()

    troubles = {
        signal.SIGKILL: arguments.kills,
        signal.SIGSTOP: arguments.hangs,
        signal.SIGUSR1: arguments.malformed,
        signal.SIGUSR2: arguments.nan,
    }
    plan = [int(number) for number, count in troubles.items() for _ in range(count)]
    rng = random.Random(arguments.seed)
    rng.shuffle(plan)

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        trainer = start(folder, arguments, len(plan))
        done = disturb(trainer, plan, arguments.every_s, rng)
        code = trainer.wait()
        if not (folder / "run" / "metrics.csv").exists():  # it ended before it began, and has said why
            return code or 1

        print(f"troubles: {dict(Counter(signal.Signals(number).name for number in done))}")
        return report(folder / "run", code, len(done))


def start(folder: Path, arguments: argparse.Namespace, troubles: int) -> subprocess.Popen:
    """Build the player and start the training."""
    build = folder / "Faulty.x86_64"
    command = shlex.join([sys.executable, str(Path(__file__).absolute()), "serve"])
    build.write_text(f'#!/bin/sh\nexec {command} "$@"\n')
    build.chmod(0o755)

    options = [
        "env=3DBall",
        "env.backend=player",
        f"env.file_name={build}",
        f"env.timeout_s={HANG_TIMEOUT_S}",
        f"env.max_restarts={2 * troubles}",
        f"max_steps={arguments.max_steps}",
        f"seed={arguments.seed}",
        f"hydra.run.dir={folder / 'run'}",
        "log.progress=false",
    ]
    code = "from mappo_unity.cli import train_main; raise SystemExit(train_main())"
    return subprocess.Popen([sys.executable, "-c", code, *options, *arguments.options])


def disturb(trainer: subprocess.Popen, plan: list[int], every_s: float, rng: random.Random) -> list[int]:
    """Send the planned signals to the trainer's player at random moments; return those that were sent."""
    done: list[int] = []
    last = 0
    while trainer.poll() is None and len(done) < len(plan):
        time.sleep(rng.expovariate(1 / every_s))
        pid = player_of(trainer.pid)
        if pid is None or pid == last:
            continue  # still starting, or not yet replaced

        try:
            os.kill(pid, plan[len(done)])
        except ProcessLookupError:
            continue
        done.append(plan[len(done)])
        last = pid
    return done


def player_of(pid: int) -> int | None:
    """Return the process id of a trainer's player that serves already (Linux)."""
    for task in Path(f"/proc/{pid}/task").glob("*/children"):
        for child in task.read_text().split():
            command = Path(f"/proc/{child}/cmdline").read_bytes()
            if b"--mlagents-port" in command and b"serve" in command and catches(int(child), signal.SIGUSR2):
                return int(child)
    return None


def catches(pid: int, number: int) -> bool:
    """Return whether a process has a handler for a signal (Linux)."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    mask = next(line for line in lines if line.startswith("SigCgt")).split()[1]
    return bool(int(mask, 16) >> (number - 1) & 1)


def report(run: Path, code: int, troubles: int) -> int:
    """Print how it ended; return the exit code."""
    from mappo_unity.policies.evaluate import evaluate
    from mappo_unity.runs.checkpoint_file import checkpoints_in
    from mappo_unity.runs.metrics_csv import read_metrics

    last = read_metrics(run / "metrics.csv")[-1]
    for name in ("agent_steps", "return_mean", "episode_length_mean", "episodes"):
        print(f"{name}: {last[name]:,.1f}")
    for name in ("restarts", "dropped_episodes", "dropped_steps"):
        print(f"{name}: {last[name]:,.0f}")

    final = checkpoints_in(run)[-1]
    earned = evaluate(final, episodes=100)["mean_return"] if code == 0 else float("nan")
    solved = earned >= 95
    counted = int(last["restarts"]) == troubles
    print(f"exit code {code}; {troubles} troubles, {last['restarts']:.0f} restarts")
    print(f"{final.name}, 100 episodes: mean return {earned:.2f}: {'solved' if solved else 'NOT solved'}")
    return 0 if solved and counted else 1


def serve(arguments: list[str]) -> int:
    """Serve 3DBall as a player that goes wrong on signals."""
    from mappo_unity.cli import player_main
    from mappo_unity.protocol import serve as player

    wrong: set[str] = set()

    class Faulty(player.Player):
        def _output(self) -> bytes:
            if "malformed" in wrong:
                return b"\x0a\xff\xff\xff"  # a field that claims more bytes than there are
            if "nan" in wrong:
                for name in self.env.behavior_specs:
                    for steps in self.env.get_steps(name):
                        steps.reward[:] = float("nan")
            return super()._output()

    signal.signal(signal.SIGUSR1, lambda *_: wrong.add("malformed"))
    signal.signal(signal.SIGUSR2, lambda *_: wrong.add("nan"))
    player.Player = Faulty  # type: ignore[misc]
    return player_main(["3DBall", *arguments])


if __name__ == "__main__":
    run_script(main if sys.argv[1:2] != ["serve"] else lambda: serve(sys.argv[2:]))
