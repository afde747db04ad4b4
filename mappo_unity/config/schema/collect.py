"""Options of collecting: `collect.*`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any, Optional

from mappo_unity.config.parameters.curriculum import is_curriculum
from mappo_unity.config.schema.checks import above, at_least
from mappo_unity.errors import ConfigError


class Engine(Enum):
    """Where workers run."""

    local = "local"
    processes = "processes"
    ray = "ray"


@dataclass
class CollectConfig:
    """Collecting experience."""

    batch_size: int = 8192
    """Agent decisions in a batch at least (ML-Agents' buffer_size)."""
    rounds: Optional[int] = None
    """Rounds (environment steps) in a batch, instead of collect.batch_size: rounds x agents decisions."""
    workers: int = 0
    """Workers that share env.num_areas or env.num_players; 0: one environment in this process."""
    engine: Engine = Engine.processes
    """Where workers run: each in its own process (processes), one after another in this one (local), or as
    actors of Ray (ray): of the cluster that RAY_ADDRESS names, or of one that is started here."""
    overlap: bool = False
    """Workers collect the next batch while this one is learnt from, with the weights before it."""
    timeout_s: float = 300.0
    """Seconds after which a worker's process that plays no round is replaced, see env.max_restarts."""

    def __post_init__(self) -> None:
        at_least("collect.batch_size", self.batch_size, 1)
        at_least("collect.rounds", self.rounds, 1)
        at_least("collect.workers", self.workers, 0)
        above("collect.timeout_s", self.timeout_s, 0)
        if self.overlap and in_one_process(self):
            raise ConfigError(
                "collect.overlap=true needs collect.workers=1 or more with collect.engine=processes or ray: "
                "in one process nothing is collected while it learns"
            )


def in_one_process(collect: CollectConfig) -> bool:
    """Return whether nothing can be collected while the learner learns."""
    return not collect.workers or collect.engine is Engine.local


def what_needs_turns(params: Mapping[str, Any], team_change: Optional[int]) -> Optional[str]:
    """Return what keeps a batch from beginning before the last one is learnt from; None where nothing does.

    Args:
        params: parameters of the environment, as options write them (env.params).
        team_change: self_play.team_change.
    """
    for name, value in params.items():
        if is_curriculum(value):
            return (
                f"env.params.{name} has lessons, which do not go with collect.overlap=true: "
                "the next batch would begin before its lesson is known"
            )

    if team_change is not None:
        return (
            f"self_play.team_change={team_change} does not go with collect.overlap=true: "
            "the next batch would begin before it is known that the other side learns"
        )
    return None
