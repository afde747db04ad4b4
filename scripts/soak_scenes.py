#!/usr/bin/env python3
"""Play scenes at random for hours of simulated time, and check everything that must hold all the while.

    scripts/soak_scenes.py [--scenes 3DBall Walker ...] [--hours 2] [--num-areas 4] [--seed 0]

Checked: no NaN or infinity in any observation or reward; no warning from MuJoCo (unstable simulation) and no
invalid floating-point operation in numpy; resident memory grows by less than 2% after a warm-up of a quarter
of the time; every reset lies in its stated range; bodies stay within the walls (`scene_ranges`).
Play changes between fresh random actions and random actions that are held for ten decisions on average,
which take agents farther, every simulated minute.

Hours count on each scene's own clock (4 areas play four times as much). Every scene runs in a process of its
own, one after the other. Prints a table, then the extremes seen beside their ranges, then all faults; the
exit code is 1 if there are faults.
"""

from __future__ import annotations

import argparse
import gc
import multiprocessing
import os
import sys
import time
from collections import Counter
from dataclasses import dataclass, field
from typing import Any

for variable in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(variable, "1")

import mujoco  # noqa: E402
import numpy as np  # noqa: E402
from mlagents_envs.base_env import ActionTuple, BehaviorSpec, DecisionSteps, TerminalSteps  # noqa: E402
from run_script import positive, run_script  # noqa: E402
from scene_ranges.ranges import Seen  # noqa: E402

from mappo_unity.scenes import make_scene  # noqa: E402
from mappo_unity.scenes.contract.play import random_actions  # noqa: E402
from mappo_unity.scenes.registry import BUILT_IN, ranges_of  # noqa: E402

TICK_S = {"Walker": 0.01333}  # others 0.02
WARM_UP = 0.25  # of the time
MAX_GROWTH = 0.02  # of the resident memory after it
MINUTE = 3000  # ticks between the two kinds of play
HELD = 10  # decisions for which an action is held, on average
PLACES = 4096  # of held actions, by agent id


@dataclass
class Report:
    """What a soak of one scene found."""

    scene: str
    num_areas: int
    hours: float = 0.0
    ticks: int = 0
    decisions: int = 0
    episodes: int = 0
    resets: int = 0
    largest_obs: float = 0.0
    largest_reward: float = 0.0
    warnings: int = 0
    memory_mb: float = 0.0
    growth: float = 0.0
    cpu_s: float = 0.0
    seen: dict[str, Seen] = field(default_factory=dict)
    faults: dict[str, list[Any]] = field(default_factory=dict)


class RandomPlay:
    """Random actions, fresh ones or held ones."""

    def __init__(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)
        self.held: dict[str, ActionTuple] = {}

    def act(self, name: str, spec: BehaviorSpec, decisions: DecisionSteps, hold: bool) -> ActionTuple:
        """Return an action for every row of `decisions`."""
        fresh = random_actions(name, spec, decisions, self.rng)
        if not hold:
            return fresh

        if name not in self.held:
            size, branches = spec.action_spec.continuous_size, spec.action_spec.discrete_size
            self.held[name] = ActionTuple(
                np.zeros((PLACES, size), np.float32), np.zeros((PLACES, branches), np.int32)
            )

        held, place = self.held[name], decisions.agent_id % PLACES
        new = self.rng.random(len(place)) < 1 / HELD
        held.continuous[place[new]] = fresh.continuous[new]
        held.discrete[place[new]] = fresh.discrete[new]
        return ActionTuple(held.continuous[place], held.discrete[place])


def soak(scene: str, hours: float, num_areas: int, seed: int = 0) -> Report:
    """Play a scene for `hours` of its own clock and return what was found."""
    report = Report(scene, num_areas)

    # both warn by a call here instead of a line
    warnings: Counter[str] = Counter()
    mujoco.set_mju_user_warning(lambda message: warnings.update([message.partition(" Time")[0]]))
    before = np.seterr(divide="call", over="call", invalid="call")
    caller = np.seterrcall(lambda kind, flag: warnings.update([f"numpy: {kind}"]))

    env = make_scene(scene, seed=seed, num_areas=num_areas)
    ranges = ranges_of(scene)(env)
    tick_s = TICK_S.get(scene, 0.02)
    start = time.process_time()
    try:
        _play(env, ranges, report, round(hours * 3600 / tick_s), RandomPlay(seed))
    except FloatingPointError as error:
        ranges.fault("the simulation goes on", str(error))
    finally:
        np.seterr(**before)
        np.seterrcall(caller)
        mujoco.set_mju_user_warning(None)
        env.close()

    for message, count in warnings.items():
        ranges.faults[f"warning: {message}"] = [count, ""]
    if report.growth > MAX_GROWTH:
        ranges.fault("memory growth below 2%", f"{report.growth:.2%} of {report.memory_mb:.0f} MB")

    report.cpu_s, report.warnings = time.process_time() - start, warnings.total()
    report.hours = report.ticks * tick_s / 3600
    report.resets, report.seen, report.faults = ranges.resets, ranges.seen, ranges.faults
    return report


def _play(env: Any, ranges: Any, report: Report, num_ticks: int, play: RandomPlay) -> None:
    """Play for so many ticks, and count and check what the scene reports."""

    def tick() -> None:
        report.ticks += 1
        ranges.tick()

    env.after_tick = tick
    env.reset()

    warm = 0.0  # MB after the warm-up
    while report.ticks < num_ticks:
        hold = report.ticks // MINUTE % 2 == 1
        for name, spec in env.behavior_specs.items():
            decisions, terminals = env.get_steps(name)
            report.episodes += len(terminals)

            _check_records(name, terminals, ranges, report)
            if len(decisions):
                report.decisions += len(decisions)
                _check_records(name, decisions, ranges, report)
                env.set_actions(name, play.act(name, spec, decisions, hold))
        env.step()

        if not warm and report.ticks >= WARM_UP * num_ticks:
            warm = resident_mb()

    report.memory_mb = resident_mb()
    report.growth = report.memory_mb / warm - 1


def _check_records(name: str, steps: DecisionSteps | TerminalSteps, ranges: Any, report: Report) -> None:
    if not len(steps):
        return
    rewards = float(np.max([np.abs(steps.reward), np.abs(steps.group_reward)]))  # NaN if there is one
    largest = float(np.max([np.abs(obs).max() for obs in steps.obs]))
    if not (np.isfinite(rewards) and np.isfinite(largest)):
        ranges.fault(f"observations and rewards of {name} are finite", f"agents {steps.agent_id.tolist()}")
        return
    report.largest_obs = max(report.largest_obs, largest)
    report.largest_reward = max(report.largest_reward, rewards)


def resident_mb() -> float:
    """Return the resident memory of this process, MB (Linux)."""
    gc.collect()
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def table(reports: list[Report]) -> str:
    """Return the reports as a Markdown table."""
    lines = [
        "| scene | areas | hours | ticks | decisions | episodes | resets checked | largest obs "
        "| warnings | memory | growth | CPU | faults |",
        "|---|" + "---:|" * 12,
    ]
    for r in reports:
        lines.append(
            f"| {r.scene} | {r.num_areas} | {r.hours:.2f} | {r.ticks:,} | {r.decisions:,} | {r.episodes:,} "
            f"| {r.resets:,} | {r.largest_obs:.4g} | {r.warnings} | {r.memory_mb:.0f} MB | {r.growth:+.2%} "
            f"| {r.cpu_s:.0f} s | {sum(count for count, _ in r.faults.values())} |"
        )
    return "\n".join(lines)


def extremes(report: Report) -> str:
    """Return the extremes seen of one scene, beside their ranges."""
    lines = [report.scene]
    for what, seen in report.seen.items():
        values = f"{seen.lowest:.6g} .. {seen.highest:.6g}"
        lines.append(f"  {what:<58} {values:<28} in {seen.low:g} .. {seen.high:g} ({seen.count:,} values)")
    return "\n".join(lines)


def main() -> int:
    """Soak the scenes, print what was found, and return 1 if there are faults."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--scenes", nargs="+", default=list(BUILT_IN), choices=list(BUILT_IN), metavar="SCENE"
    )
    parser.add_argument("--hours", type=float, default=2.0, help="of simulated time in each scene")
    parser.add_argument("--num-areas", type=positive, default=4)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()

    reports = []
    for scene in options.scenes:
        with multiprocessing.get_context("spawn").Pool(1) as pool:  # memory counts by process
            report = pool.apply(soak, (scene, options.hours, options.num_areas, options.seed))
        reports.append(report)
        print(
            f"{scene}: {report.hours:.2f} h in {report.cpu_s:.0f} s, {len(report.faults)} kinds of faults",
            file=sys.stderr,
            flush=True,
        )

    print(table(reports))
    for report in reports:
        print(f"\n{extremes(report)}")

    faulty = [report for report in reports if report.faults]
    for report in faulty:
        for rule, (count, case) in report.faults.items():
            print(f"\nFAULT {report.scene}: {rule} ({count} times; first {case})")
    return 1 if faulty else 0


if __name__ == "__main__":
    run_script(main)
