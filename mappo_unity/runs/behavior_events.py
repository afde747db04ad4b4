"""TensorBoard curves as ML-Agents writes them: a folder for each behavior, its tags, its own steps.

A point is the mean of what iterations said since the point before, at a multiple of the summary frequency.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from mappo_unity.runs.metrics_csv import keep_events, read_metrics

if TYPE_CHECKING:
    from torch.utils.tensorboard import SummaryWriter

Row = Mapping[str, "int | float"]

_STEPS = "/agent_steps"
_TAGS: dict[str, str] = {
    "entropy": "Policy/Entropy",
    "lr": "Policy/Learning Rate",
    "clip_epsilon": "Policy/Epsilon",
    "entropy_coef": "Policy/Beta",
    "value_mean": "Policy/Extrinsic Value Estimate",
    "curiosity_value_mean": "Policy/Curiosity Value Estimate",
    "rnd_value_mean": "Policy/Rnd Value Estimate",
    "gail_value_mean": "Policy/Gail Value Estimate",
    "value_loss": "Losses/Value Loss",
    "rnd_loss": "Losses/RND Loss",
    "gail_loss": "Losses/GAIL Loss",
    "bc_loss": "Losses/Pretraining Loss",
}
_MADE: dict[str, Callable[[Row], float]] = {
    "Environment/Cumulative Reward": lambda row: row["return_mean"] - row["group_return_mean"],
    "Environment/Episode Length": lambda row: row["episode_length_mean"] - 1,
    "Policy/Extrinsic Reward": lambda row: row["return_mean"],
    "Policy/Curiosity Reward": lambda row: row["curiosity_reward"] * row["episode_length_mean"],
    "Policy/Rnd Reward": lambda row: row["rnd_reward"] * row["episode_length_mean"],
    "Policy/Gail Reward": lambda row: row["gail_reward"] * row["episode_length_mean"],
    "Losses/Policy Loss": lambda row: abs(row["policy_loss"]),
}
"""Tags whose value is made of ours; left out where one of them is missing."""
_COUNTS = ("iteration", "agent_steps", "wall_s", "episodes")
_LESSON = "lesson/"


def policy_step(policy: str) -> str:
    """Return the name under which a row has a policy's decisions."""
    return policy + _STEPS


def mlagents_tags(row: Row, policy: str, policies: list[str]) -> dict[str, float]:
    """Return a behavior's part of a row under ML-Agents' tags; what it has none for keeps its name.

    Args:
        row: of the run.
        policy: whose part.
        policies: all of the run; with several, rows have ``NAME/metric``.
    """
    own = _own_part(row, policy, policies)
    out: dict[str, float] = {}
    for tag, value in _MADE.items():
        try:
            out[tag] = value(own)
        except KeyError:
            pass

    group = own.get("group_return_mean", 0.0)
    if group and not math.isnan(group):
        out["Environment/Group Cumulative Reward"] = group
    for name, number in own.items():
        if name.startswith(_LESSON):
            out[f"Environment/Lesson Number/{name[len(_LESSON) :]}"] = number
        elif name not in _COUNTS and "?team=" not in name:
            out[_TAGS.get(name, name)] = number
    return {tag: number for tag, number in out.items() if not math.isnan(number)}


class BehaviorEvents:
    """Write the curves of a run's behaviors; a resumed run goes on in their folders.

    Args:
        folder: of the run, whose metrics.csv ends where the run is resumed.
        frequency: decisions of a behavior between two points.
    """

    def __init__(self, folder: Path, frequency: int) -> None:
        self._folder, self._frequency = folder, frequency
        self._writers: dict[str, SummaryWriter] = {}
        self._sums: dict[str, dict[str, tuple[float, int]]] = {}
        self._points: dict[str, int] = {}

        metrics = folder / "metrics.csv"
        rows = read_metrics(metrics) if metrics.is_file() else []
        for policy, steps in _policy_steps(rows[-1] if rows else {}).items():
            self._points[policy] = steps // frequency
            for path in sorted((folder / policy).glob("*tfevents*")):
                keep_events(path, steps)

    def add(self, row: Row) -> Iterator[str]:
        """Take a row in; yield a line, as ML-Agents prints it, about each behavior with a new point."""
        steps = _policy_steps(row)
        for policy, count in steps.items():
            sums = self._sums.setdefault(policy, {})
            for tag, number in mlagents_tags(row, policy, list(steps)).items():
                total, n = sums.get(tag, (0.0, 0))
                sums[tag] = (total + number, n + 1)

            point = count // self._frequency
            if point > self._points.get(policy, 0):
                self._points[policy] = point
                yield self._write(policy, point * self._frequency, row, list(steps))

    def close(self) -> None:
        """Close the files."""
        for writer in self._writers.values():
            writer.close()

    def _write(self, policy: str, step: int, row: Row, policies: list[str]) -> str:
        writer = self._writer(policy)
        means = {tag: total / n for tag, (total, n) in self._sums.pop(policy).items()}
        for tag, number in means.items():
            writer.add_scalar(tag, number, step)
        writer.flush()
        return _line(policy, step, means, _own_part(row, policy, policies))

    def _writer(self, policy: str) -> SummaryWriter:
        if policy not in self._writers:
            from torch.utils.tensorboard import SummaryWriter

            self._writers[policy] = SummaryWriter(str(self._folder / policy))
        return self._writers[policy]


def _line(policy: str, step: int, means: Mapping[str, float], own: Row) -> str:
    head = f"[INFO] {policy}. Step: {step}. Time Elapsed: {own['wall_s']:.3f} s. "
    reward = means.get("Environment/Cumulative Reward")
    if reward is None:
        return f"{head}No episode was completed since last summary. Training."

    head += f"Mean Reward: {reward:.3f}. "
    group = means.get("Environment/Group Cumulative Reward")
    spread = own.get("return_std", math.nan)
    head += f"Std of Reward: {spread:.3f}. " if group is None else f"Mean Group Reward: {group:.3f}. "
    elo = means.get("Self-play/ELO")
    return head + "Training." + ("" if elo is None else f" ELO: {elo:.3f}.")


def _policy_steps(row: Row) -> dict[str, int]:
    return {name[: -len(_STEPS)]: int(count) for name, count in row.items() if name.endswith(_STEPS)}


def _own_part(row: Row, policy: str, policies: list[str]) -> dict[str, float]:
    """Return a policy's metrics without its name: its own ones above those of the run."""
    out = {name: n for name, n in row.items() if not any(name.startswith(f"{p}/") for p in policies)}
    for name, number in row.items():
        if name.startswith(f"{policy}/"):
            out[name[len(policy) + 1 :]] = number

    # episodes are counted by side
    sides = [name for name in row if name.startswith(f"{policy}?team=")]
    for metric in dict.fromkeys(name.rpartition("/")[2] for name in sides):
        numbers = [row[name] for name in sides if name.rpartition("/")[2] == metric]
        known = [number for number in numbers if not math.isnan(number)]
        out[metric] = sum(known) / len(known) if known else math.nan
    return out
