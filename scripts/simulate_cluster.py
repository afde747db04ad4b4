#!/usr/bin/env python3
"""Simulate training with many workers and learners: what it would bring, and what would limit it.

First a scene's preset is trained here for some iterations on one core. Their seconds of collecting and of
learning, the bytes of a batch and of the weights are what the simulation is made of: every worker is a timer
that draws its seconds from those measured, and has as many areas as the preset. A learner waits for all of
its workers (as `collect.workers` does, with overlap), fetches what comes from other machines over its link,
learns from the whole batch, and exchanges gradients with the other learners after each minibatch.

    python scripts/simulate_cluster.py [--scene SoccerTwos] [--link 10] [--speedup 20] [--cores 64]

What is assumed, not measured: the link (Gbit/s, of each machine), how much faster than this core a learner
learns (an accelerator), cores of a machine, 0.2 ms for a message, and that cores do not disturb each other.
"""

from __future__ import annotations

import argparse
import os
import statistics
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from run_script import positive, run_script

from mappo_unity.config.compose import compose_config
from mappo_unity.training.collection.fleet import weights_of
from mappo_unity.training.setup import set_up

WARM_UP = 2  # iterations that are left out
LATENCY_S = 2e-4  # of a message between machines
COPY_BYTES_PER_S = 8e9  # joining batches in memory: 53.8 MiB took 6.8 ms (docs/scaling.md)
PLANS = ((1, 1), (2, 1), (8, 1), (62, 1), (186, 1), (992, 1), (992, 16))  # workers, learners


@dataclass(frozen=True)
class Measured:
    """What one core did: seconds of each iteration, and sizes."""

    collect_s: np.ndarray  # [iterations]
    update_s: np.ndarray  # [iterations]
    decisions: float  # of an iteration
    steps: int  # minibatches of an iteration
    batch_bytes: int
    weights_bytes: int


def main() -> None:
    """Measure, simulate, print a table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scene", default="SoccerTwos")
    parser.add_argument("--iterations", type=positive, default=12, help="measured ones")
    parser.add_argument("--link", type=float, default=10.0, help="Gbit/s of each machine")
    parser.add_argument("--speedup", type=float, nargs="+", default=[1.0, 20.0], help="of learning")
    parser.add_argument("--cores", type=int, default=64, help="of a machine; two of them are the learner's")
    arguments = parser.parse_args()

    print(f"load average {os.getloadavg()[0]:.2f}, {os.cpu_count()} cores")
    measured = measure(arguments.scene, arguments.iterations)
    print(
        f"{arguments.scene}, one core: {measured.decisions:,.0f} decisions an iteration, collected in "
        f"{np.median(measured.collect_s):.2f} s ({measured.collect_s.min():.2f} to "
        f"{measured.collect_s.max():.2f}), learnt from in {np.median(measured.update_s):.2f} s; batch "
        f"{measured.batch_bytes / 2**20:.1f} MiB, weights {measured.weights_bytes / 2**20:.2f} MiB"
    )

    alone = measured.decisions / float(np.mean(measured.collect_s + measured.update_s))
    print("\n| workers | learners | learning | decisions/s | of one core | of no limits | limit |")
    print("|---" * 7 + "|")
    for speedup in arguments.speedup:
        for workers, learners in PLANS:
            rate, limit = simulate(measured, workers, learners, speedup, arguments)
            ideal = workers * measured.decisions / float(np.mean(measured.collect_s))
            print(
                f"| {workers} | {learners} | {speedup:g} x | {rate:,.0f} | {rate / alone:.1f} x | "
                f"{rate / ideal:.0%} | {limit} |"
            )
    print(f"\nload average {os.getloadavg()[0]:.2f}")


def measure(scene: str, iterations: int) -> Measured:
    """Train a scene's preset on one core and return what it took."""
    cfg = compose_config([f"env={scene}", "update_threads=1", "log.loggers=[]"]).config
    collect_s, update_s, decisions = [], [], []
    with tempfile.TemporaryDirectory() as out, set_up(cfg, Path(out)) as setup, setup.collecting() as batches:
        for _ in range(WARM_UP + iterations):
            start = time.perf_counter()
            batch = next(batches)
            collected = time.perf_counter()
            setup.learn(batch, 0.0)
            collect_s.append(collected - start)
            update_s.append(time.perf_counter() - collected)
            decisions.append(sum(batch.count_decisions(name) for name in setup.learners))

        tensors = [weight for actor in weights_of(setup.policy).values() for weight in actor.values()]
        return Measured(
            np.array(collect_s[WARM_UP:]),
            np.array(update_s[WARM_UP:]),
            statistics.mean(decisions[WARM_UP:]),
            int(cfg.ppo.epochs * statistics.mean(decisions[WARM_UP:]) / cfg.ppo.minibatch_size),
            int(batch.rounds.bytes()),
            sum(weight.nbytes for weight in tensors),
        )


def simulate(
    measured: Measured, workers: int, learners: int, speedup: float, arguments: argparse.Namespace
) -> tuple[float, str]:
    """Return decisions a second of so many workers and learners, and what takes longest."""
    random = np.random.default_rng(0)
    rounds, own = 200, workers // learners
    link = arguments.link * 1e9 / 8

    # the slowest of a learner's workers, and the slowest learner of all: gradients wait for everybody
    collect = random.choice(measured.collect_s, (rounds, workers)).max(1)
    update = random.choice(measured.update_s, (rounds, learners)).max(1) * own / speedup

    remote = max(0, own - (arguments.cores - 2))  # workers that are not on their learner's machine
    fetch = remote * (measured.batch_bytes + measured.weights_bytes) / link + (remote > 0) * LATENCY_S
    join = own * measured.batch_bytes / COPY_BYTES_PER_S
    share = 2 * (learners - 1) / learners * measured.weights_bytes / link + 2 * LATENCY_S * (learners > 1)
    learn = update + join + measured.steps * share

    seconds = np.maximum(np.maximum(collect, fetch), learn).mean()
    parts = {"collecting": collect.mean(), "link": fetch, "learning": learn.mean()}
    return workers * measured.decisions / float(seconds), max(parts, key=lambda name: float(parts[name]))


if __name__ == "__main__":
    run_script(main)
