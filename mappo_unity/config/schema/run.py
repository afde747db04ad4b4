"""Options of a run: the sections, and those that stand in none."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from enum import Enum
from typing import Any, Optional

from mappo_unity.config.parameters.values import curricula
from mappo_unity.config.schema.checks import at_least, not_empty, rule, within
from mappo_unity.config.schema.collect import CollectConfig
from mappo_unity.config.schema.env import Backend, EnvConfig
from mappo_unity.config.schema.log import LogConfig
from mappo_unity.config.schema.model import ModelConfig
from mappo_unity.config.schema.ppo import PPOConfig
from mappo_unity.config.schema.rewards import BCConfig, RewardsConfig
from mappo_unity.config.schema.self_play import MatchConfig, SelfPlayConfig
from mappo_unity.config.schema.workers import what_needs_turns, what_workers_share
from mappo_unity.errors import ConfigError


class MatmulPrecision(Enum):
    """How products of float32 matrices are computed."""

    highest = "highest"
    high = "high"
    medium = "medium"


@dataclass
class Config:
    """Options of a run."""

    env: EnvConfig = field(default_factory=EnvConfig)
    """The environment."""
    model: ModelConfig = field(default_factory=ModelConfig)
    """The actor's and the critic's networks."""
    ppo: PPOConfig = field(default_factory=PPOConfig)
    """The learner."""
    rewards: RewardsConfig = field(default_factory=RewardsConfig)
    """Streams of rewards beside the environment's own."""
    bc: BCConfig = field(default_factory=BCConfig)
    """Behavioral cloning from demonstrations."""
    collect: CollectConfig = field(default_factory=CollectConfig)
    """Collecting experience."""
    self_play: SelfPlayConfig = field(default_factory=SelfPlayConfig)
    """Self-play against past policies."""
    matches: MatchConfig = field(default_factory=MatchConfig)
    """Matches against a random side while training."""
    log: LogConfig = field(default_factory=LogConfig)
    """Metrics and progress."""
    behaviors: dict[str, Any] = field(default_factory=dict)
    """Options of one behavior name: behaviors.Goalie.ppo.lr=1e-4 overrides ppo.lr for Goalie; sections
    ppo, model, rewards and bc, init_from, and train=false for one that only plays."""
    only_named_behaviors: bool = False
    """Refuse an environment that has behaviors without an entry in `behaviors`, as ML-Agents does."""
    seed: int = 0
    """Seed of the environment, the networks and the sampling."""
    max_steps: int = 1_000_000
    """Agent decisions after which the run ends."""
    checkpoint_interval: int = 100_000
    """Agent decisions between two checkpoints."""
    keep_checkpoints: int = 5
    """Newest checkpoints that are kept, besides the best one."""
    export_onnx: bool = True
    """Write an ONNX file, which Unity loads, beside the best and the final checkpoint."""
    device: str = "cpu"
    """Device of the networks: cpu, cuda or cuda:N."""
    num_threads: int = 1
    """Threads of torch while collecting; small networks want one."""
    update_threads: int = 1
    """Threads of torch while learning, at most one a core; large minibatches gain where a core is idle."""
    matmul_precision: MatmulPrecision = MatmulPrecision.highest
    """Of float32 matrix products while training, as torch.set_float32_matmul_precision has it: highest, high
    (TensorFloat32 on GPUs) or medium (bfloat16 inside, on CPUs that have instructions for it, too)."""
    learners: int = 1
    """Processes that learn side by side, each from a part of the teams; with device=cuda on a GPU each."""
    resume: Optional[str] = None
    """Run folder or checkpoint file to resume, in the same folder."""
    init_from: Optional[str] = None
    """Run folder, checkpoint or ONNX file whose networks a new run begins with, as far as they fit."""
    stop_at_return: Optional[float] = None
    """End the run when return_mean over a full window reaches this."""
    max_jobs: int = 1000
    """With -m: jobs of a grid at most; a larger one is refused before anything is checked."""
    output_dir: str = "outputs"
    """Folder under which run folders are made."""

    def __post_init__(self) -> None:
        not_empty(output_dir=self.output_dir.strip())
        within("seed", self.seed, 0, 2**31 - 1)
        at_least("max_steps", self.max_steps, 1)
        at_least("checkpoint_interval", self.checkpoint_interval, 1)
        at_least("keep_checkpoints", self.keep_checkpoints, 1)
        at_least("num_threads", self.num_threads, 1)
        at_least("update_threads", self.update_threads, 1)
        at_least("learners", self.learners, 1)
        at_least("max_jobs", self.max_jobs, 1)
        rule("stop_at_return", self.stop_at_return, True, "must be a finite number or null")

        if not re.fullmatch(r"cpu|cuda(:[0-9]+)?", self.device):
            raise ConfigError(f"device={self.device!r} must be one of cpu, cuda, cuda:N")
        if self.bc.only:
            self._check_cloning()
        if self.collect.workers:
            self._check_workers()

    def _check_workers(self) -> None:
        what, env = f"collect.workers={self.collect.workers}", self.env
        if self.bc.only:
            raise ConfigError(f"{what} does not go with bc.only=true, where nothing is played; leave it out")

        reason = what_needs_turns(env.params, self.self_play)
        if self.collect.overlap and reason is not None:
            raise ConfigError(f"{reason}; give collect.overlap=false")
        self._check_shares(what)

    def _check_shares(self, what: str) -> None:
        """Refuse workers among which the environment cannot be shared evenly."""
        env, workers = self.env, self.collect.workers
        if env.backend is Backend.editor and workers > 1:
            raise ConfigError(f"{what} does not go with env.backend=editor: there is one Editor")

        key, shared = what_workers_share(env) or ("", workers)
        if shared is None:
            raise ConfigError(f"{what} shares the areas: give env.num_areas, a multiple of {workers}")
        if shared % workers:
            below, above = shared // workers * workers, -(-shared // workers) * workers
            choices = f"{below} or {above}" if below else f"{above}"
            raise ConfigError(
                f"{key}={shared} cannot be shared by {what}: it must be a multiple of {workers}, such as "
                f"{choices}"
            )

    def _check_cloning(self) -> None:
        own = [section.get("bc") for section in self.behaviors.values() if isinstance(section, dict)]
        if not self.bc.demos and not any(bc.get("demos") for bc in own if isinstance(bc, dict)):
            raise ConfigError("bc.only=true needs demonstrations: bc.demos=[expert.demo]")

        lessons = curricula(self.env.parameters)
        if lessons:
            raise ConfigError(
                f"env.params.{next(iter(lessons))} has lessons, which do not go with bc.only=true: the "
                "environment is not played; give a number, or leave it out"
            )
        if self.stop_at_return is not None:
            raise ConfigError(
                f"stop_at_return={self.stop_at_return:g} does not go with bc.only=true, where the return is "
                "the recording's; max_steps ends the run"
            )
