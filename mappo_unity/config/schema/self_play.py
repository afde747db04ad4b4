"""Options of environments with two sides: `self_play.*` and `matches.*`."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum
from typing import Optional

from mappo_unity.config.schema.checks import at_least, rule, within
from mappo_unity.errors import ConfigError


class OpponentDraw(Enum):
    """How past opponents are drawn."""

    uniform = "uniform"
    hardest = "hardest"


@dataclass
class SelfPlayConfig:
    """Self-play against past policies, in environments with two sides.

    Names and defaults are ML-Agents'; decisions are those of the run.
    """

    save_steps: Optional[int] = None
    """Agent decisions between two snapshots that join the pool; null: there is none, newest play newest."""
    window: int = 10
    """Newest snapshots that are opponents."""
    play_against_latest_model_ratio: float = 0.5
    """Share of the teams whose opponent plays the newest weights."""
    swap_steps: int = 2000
    """Agent decisions after which other opponents are drawn, which play from a team's next episode on."""
    team_change: Optional[int] = None
    """Agent decisions after which the other side learns and the environment is reset (ML-Agents: 5 times
    save_steps); null: both learn, both at once where newest play newest, else one of them."""
    initial_elo: float = 1200.0
    """Elo rating at the start, and of fixed opponents."""
    opponents: OpponentDraw = OpponentDraw.uniform
    """How they are drawn: uniform, or hardest: by (1 - p)^2 for a share p won against each (as AlphaStar)."""
    num_opponents: int = 3
    """Past opponents that are met at the same time, at most; each costs a forward pass a round."""
    fixed: list[str] = field(default_factory=list)
    """Opponents that are always in the pool: random, zoo, run folders, checkpoints, ONNX files."""
    skip_missing: bool = False
    """With resume: go on without snapshots whose files are missing or damaged."""

    def __post_init__(self) -> None:
        at_least("self_play.save_steps", self.save_steps, 1)
        at_least("self_play.window", self.window, 1)
        within("self_play.play_against_latest_model_ratio", self.play_against_latest_model_ratio, 0, 1)
        at_least("self_play.swap_steps", self.swap_steps, 0)
        at_least("self_play.team_change", self.team_change, 1)
        rule("self_play.initial_elo", self.initial_elo, True, "must be a finite number")
        at_least("self_play.num_opponents", self.num_opponents, 1)
        if "" in self.fixed:
            raise ConfigError(
                "self_play.fixed has an empty entry: give random, a run folder, a checkpoint or an ONNX file"
            )

    @property
    def is_on(self) -> bool:
        """Whether there is a pool of opponents."""
        return has_pool(self)


def has_pool(self_play: SelfPlayConfig) -> bool:
    """Return whether past or fixed opponents are met; also of a tree of options that is no dataclass yet."""
    return self_play.save_steps is not None or bool(self_play.fixed)


@dataclass
class MatchConfig:
    """Matches while training, against a random side and other opponents, for environments with two sides.

    They choose best.pt: by the lower end of the 95 % interval of the policy's Bradley-Terry rating.
    """

    interval: Optional[int] = None
    """Agent decisions between two series of matches, with one more when max_steps are done; null: none."""
    count: int = 64
    """Matches in a series against each opponent, half of them on each side."""
    opponents: int = 3
    """Opponents at most that a series meets beside random, of those there are: the best policy, then those of
    about the same rating."""

    def __post_init__(self) -> None:
        at_least("matches.interval", self.interval, 1)
        at_least("matches.count", self.count, 2)
        at_least("matches.opponents", self.opponents, 0)
