"""Options of collecting: `collect.*`."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Optional

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
