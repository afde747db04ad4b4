"""How a training run ended, and whether one that would be resumed has anything left to train."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from mappo_unity.config.schema import Config
from mappo_unity.runs import checkpoint
from mappo_unity.training.episode_stats import RecentEpisodes
from mappo_unity.training.match_series import is_missing

FINISHED = "finished"  # max_steps are done
SOLVED = "solved"  # stop_at_return is reached
INTERRUPTED = "interrupted"  # a signal came
DIVERGED = "diverged"  # max_steps are done, but most updates of a policy were rolled back


@dataclass
class Outcome:
    """How a run ended."""

    status: str
    signal: int | None
    agent_steps: int
    wall_s: float
    return_mean: float
    best_checkpoint: Path | None
    last_checkpoint: Path | None
    updates: dict[str, tuple[int, int]] = field(default_factory=dict)
    """For each policy name: how many updates were rolled back, and how many there were."""


def why_over(cfg: Config, path: Path) -> str | None:
    """Return why a run at a checkpoint has nothing left to train, or None.

    Args:
        cfg: the options with which it would be resumed.
        path: the checkpoint.
    """
    state = checkpoint.load(path)
    if state["agent_steps"] >= cfg.max_steps:
        if is_missing(cfg, state["matches"]):  # the last series of matches is played, and no iteration
            return None
        return (
            f"it has done {state['agent_steps']:,} of max_steps={cfg.max_steps:,} steps; "
            "max_steps=N with a larger N trains on"
        )

    # the window is as long as the options of the resumed run say
    episodes = RecentEpisodes(cfg.log.return_window, list(state["window"]["recent"]))
    episodes.load_state_dict(state["window"])
    are_last = state.get("lessons", {}).get("are_last", True)
    if cfg.stop_at_return is not None and are_last and episodes.reached(cfg.stop_at_return):
        mean = episodes.summary()["return_mean"]
        return (
            f"its mean return {mean:.4g} has reached stop_at_return={cfg.stop_at_return:g}; "
            "stop_at_return=null, or a higher one, trains on"
        )
    return None
