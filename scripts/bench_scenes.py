#!/usr/bin/env python3
"""Measure bare stepping of the embedded scenes with random actions, on one core.

    scripts/bench_scenes.py [SCENE ...] [--num-areas N] [--seconds 2] [--repeats 5]

Agent decisions a second of processor time (on an idle machine that is the wall clock; on a busy one it does
not count other processes): `step`, `get_steps` and `set_actions` with ready-made actions, observations
included; medians over the repeats, with their spread. 3DBall with a simple controller, under
which balls seldom fall, is a row of its own.
"""

from __future__ import annotations

import argparse
import itertools
import os
import statistics
import time
from collections.abc import Callable, Iterator

for variable in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(variable, "1")

import numpy as np  # noqa: E402
from mlagents_envs.base_env import ActionSpec, ActionTuple, BaseEnv, BehaviorSpec, DecisionSteps  # noqa: E402
from omegaconf import OmegaConf  # noqa: E402
from run_script import positive, run_script  # noqa: E402

from mappo_unity.config.presets import conf_dir  # noqa: E402
from mappo_unity.scenes import make_scene, scene_names  # noqa: E402

RING = 1009  # actions drawn for each agent
STEPS_BETWEEN_CLOCKS = 16
Policy = Callable[[BehaviorSpec, DecisionSteps], ActionTuple]


def random_policy() -> Policy:
    """Return a policy that takes its actions in turn from a ring, drawn for the most agents seen."""
    rng = np.random.default_rng(0)
    rings: dict[ActionSpec, tuple[int, Iterator[ActionTuple]]] = {}

    def draw(spec: ActionSpec, agents: int) -> ActionTuple:
        branches = [rng.integers(0, size, agents) for size in spec.discrete_branches]
        discrete = np.stack(branches, 1) if branches else np.zeros((agents, 0))
        continuous = rng.uniform(-1, 1, (agents, spec.continuous_size))
        return ActionTuple(continuous.astype(np.float32), discrete.astype(np.int32))

    def act(spec: BehaviorSpec, decisions: DecisionSteps) -> ActionTuple:
        actions, agents = spec.action_spec, len(decisions)
        most, ring = rings.get(actions, (0, iter(())))
        if agents > most:
            most, ring = agents, itertools.cycle([draw(actions, agents) for _ in range(RING)])
            rings[actions] = most, ring
        action = next(ring)
        if agents == most:
            return action
        return ActionTuple(action.continuous[:agents], action.discrete[:agents])

    return act


def balance(spec: BehaviorSpec, decisions: DecisionSteps) -> ActionTuple:
    """Keep the ball of 3DBall up by leaning against its position and velocity."""
    obs = decisions.obs[0]
    lean_z = 0.05 * obs[:, 2] + 0.06 * obs[:, 5] - obs[:, 0]
    lean_x = -0.05 * obs[:, 4] - 0.06 * obs[:, 7] - obs[:, 1]
    return ActionTuple(np.clip(10 * np.stack([lean_z, lean_x], 1), -1, 1))


def decisions_per_s(env: BaseEnv, policy: Policy, seconds: float) -> float:
    """Step for `seconds` of processor time and return agent decisions a second."""
    count, start = 0, time.process_time()
    while (passed := time.process_time() - start) < seconds:
        for _ in range(STEPS_BETWEEN_CLOCKS):
            for name, spec in env.behavior_specs.items():
                decisions, _ = env.get_steps(name)
                if agents := len(decisions):
                    env.set_actions(name, policy(spec, decisions))
                    count += agents
            env.step()
    return count / passed


def measure(scene: str, num_areas: int | None, policy: Policy, seconds: float, repeats: int) -> str:
    """Return a row of the table."""
    env = make_scene(scene, num_areas=num_areas)
    env.reset()
    decisions_per_s(env, policy, 0.3)  # warm up, and leave the start
    rates = [decisions_per_s(env, policy, seconds) for _ in range(repeats)]
    areas = getattr(env, "num_areas", num_areas)
    env.close()
    return f"{areas!s:>6} {statistics.median(rates):>14,.0f} {min(rates):>12,.0f} {max(rates):>12,.0f}"


def usual_areas(scene: str) -> list[int | None]:
    """Return the Unity scene's number of areas (None), and that of the preset where it has another."""
    preset = conf_dir() / "env" / f"{scene}.yaml"
    areas = OmegaConf.select(OmegaConf.load(preset), "env.num_areas") if preset.is_file() else None
    return [None] if areas is None else [None, int(areas)]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenes", nargs="*", help="default: all scenes")
    parser.add_argument(
        "--num-areas", type=positive, default=None, help="default: as the Unity scene, then as the preset"
    )
    parser.add_argument("--seconds", type=float, default=2.0, help="of one repeat")
    parser.add_argument("--repeats", type=positive, default=5)
    options = parser.parse_args()
    rows = [
        (scene, "random", num_areas, random_policy())
        for scene in options.scenes or scene_names()
        for num_areas in ([options.num_areas] if options.num_areas else usual_areas(scene))
    ]
    if "3DBall" in (options.scenes or ["3DBall"]):
        rows.append(("3DBall", "balance", options.num_areas or 128, balance))
    print(f"{'scene':<18} {'policy':<8} {'areas':>6} {'decisions/s':>14} {'lowest':>12} {'highest':>12}")
    for scene, label, num_areas, policy in rows:
        print(f"{scene:<18} {label:<8} {measure(scene, num_areas, policy, options.seconds, options.repeats)}")


if __name__ == "__main__":
    run_script(main)
