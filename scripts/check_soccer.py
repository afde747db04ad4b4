#!/usr/bin/env python3
"""Play SoccerTwos matches with the policy that Unity trained, and print wins, draws and losses by side.

    scripts/check_soccer.py [--episodes 400] [--seeds 0 1 2] [--policy SoccerTwos.onnx]

The policy comes with ML-Agents' example project; it is looked for in the folder that the environment variable
MAPPO_SHARED names, or in `shared` beside the checkout, as oracle/SoccerTwos.onnx. Without it only random
sides play. Every field plays the same number of episodes, so that short ones do not count more than others.
Needs onnxruntime.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

import mappo_unity.protocol.protobuf

mappo_unity.protocol.protobuf.install()

from mlagents_envs.base_env import ActionTuple, TerminalSteps  # noqa: E402
from run_script import positive, run_script  # noqa: E402

from mappo_unity.scenes import make_scene  # noqa: E402

NUM_FIELDS = 40
BRANCHES = (3, 3, 3)
PURPLE, BLUE = "SoccerTwos?team=1", "SoccerTwos?team=0"
Policy = Callable[[list[np.ndarray]], np.ndarray]
"""Observations of n agents, one array a sensor -> branch indices [n, 3]."""


class Score(NamedTuple):
    """What a match came to, by episodes, and the mean length in decisions."""

    blue: int
    draws: int
    purple: int
    decisions: float


def random_policy(seed: int) -> Policy:
    """Return a policy that plays every action with the same probability."""
    rng = np.random.default_rng(seed)
    return lambda obs: rng.integers(0, 3, (len(obs[0]), len(BRANCHES)))


def official_policy(file: Path, seed: int) -> Policy:
    """Return the policy of an ONNX file of ML-Agents' format 2: log-probabilities, sampled here."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads, options.log_severity_level = 1, 3
    session = onnxruntime.InferenceSession(str(file), options, providers=["CPUExecutionProvider"])
    rng = np.random.default_rng(seed)

    def act(obs: list[np.ndarray]) -> np.ndarray:
        count = len(obs[0])
        feed = {
            "vector_observation": np.concatenate(obs, axis=1),
            "action_masks": np.ones((count, sum(BRANCHES)), np.float32),
        }
        log_probs = session.run(["discrete_actions"], feed)[0].reshape(count, len(BRANCHES), -1)
        probs = np.exp(log_probs.astype(np.float64)).cumsum(axis=2)
        drawn = rng.random((count, len(BRANCHES), 1)) * probs[:, :, -1:]
        return (probs < drawn).sum(axis=2)

    return act


def play(blue: Policy, purple: Policy, episodes: int, seed: int, scene: str = "SoccerTwos") -> Score:
    """Play `episodes` episodes, the same number on every field, and count who scored."""
    env = make_scene(scene, seed=seed, num_areas=NUM_FIELDS)
    env.reset()
    sides = {name: purple if name.endswith("team=1") else blue for name in env.behavior_specs}
    each = -(-episodes // NUM_FIELDS)
    length = np.zeros(NUM_FIELDS, np.int64)
    played = np.zeros(NUM_FIELDS, np.int64)
    results: list[tuple[int, int]] = []  # winner: 1 blue, -1 purple, 0 none; decisions

    while (played < each).any():
        for name, policy in sides.items():
            decisions, terminals = env.get_steps(name)

            # what blue sees of a match is all that is counted of it
            if name.endswith("team=0"):
                for row in range(0, len(terminals), 2):  # two agents of a team end together
                    field = (int(terminals.group_id[row]) - 1) // 2
                    if played[field] < each:
                        results.append((winner_of(terminals, row), int(length[field])))
                    played[field] += 1
                    length[field] = 0
                length[np.unique((decisions.group_id - 1) // 2)] += 1

            if len(decisions):
                env.set_actions(name, ActionTuple(discrete=policy(decisions.obs).astype(np.int32)))
        env.step()
    env.close()

    winners, lengths = np.array(results).T
    return Score(
        int((winners > 0).sum()), int((winners == 0).sum()), int((winners < 0).sum()), lengths.mean()
    )


def winner_of(terminals: TerminalSteps, row: int) -> int:
    """Return who has won a match, by the end of one of blue's agents: 1 blue, -1 purple, 0 none."""
    return 0 if terminals.interrupted[row] else int(np.sign(terminals.group_reward[row]))


def report(match: str, seed: int, score: Score, seconds: float) -> None:
    """Print one line of the table."""
    decided, played = score.blue + score.purple, score.blue + score.draws + score.purple
    print(
        f"{match:28} {seed:4} {score.blue:6} {score.draws:6} {score.purple:7}"
        f" {100 * score.blue / max(decided, 1):9.1f} {100 * score.draws / played:7.1f}"
        f" {score.decisions:10.1f} {seconds:7.0f}",
        flush=True,
    )


def main() -> None:
    """Play all matches and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--episodes", type=positive, default=400)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--policy", type=Path, default=shared_folder() / "oracle" / "SoccerTwos.onnx")
    args = parser.parse_args()

    matches = ["random - random"]
    if args.policy.is_file():
        matches = ["official - random", "random - official", "official - official", *matches]
    else:
        print(f"no policy at {args.policy}: its matches are skipped (--policy, or MAPPO_SHARED)")

    print(f"{'blue - purple':28} seed   blue  draws  purple  blue won%  draws%  decisions   CPU s")
    for match in matches:
        for seed in args.seeds:
            start = time.process_time()
            blue, purple = (
                official_policy(args.policy, seed) if side == "official" else random_policy(seed + number)
                for number, side in enumerate(match.split(" - "))
            )
            report(match, seed, play(blue, purple, args.episodes, seed), time.process_time() - start)

    for seed in args.seeds:
        start = time.process_time()
        score = play(random_policy(seed), random_policy(seed + 1), args.episodes, seed, "StrikersVsGoalie")
        report("random strikers - goalie", seed, score, time.process_time() - start)

    print("blue won%: of the decided episodes")


def shared_folder() -> Path:
    """Return where the official policies may lie."""
    beside = Path(__file__).resolve().parents[1].parent / "shared"
    return Path(os.environ.get("MAPPO_SHARED", beside))


if __name__ == "__main__":
    run_script(main)
