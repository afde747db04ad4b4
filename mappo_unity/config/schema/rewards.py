"""Options of reward streams and of cloning: `rewards.*` and `bc.*`."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Optional

from mappo_unity.config.schema.checks import above, at_least, widths, within
from mappo_unity.errors import ConfigError


@dataclass
class ExtrinsicConfig:
    """The environment's own rewards, individual and group reward."""

    strength: float = 1.0
    """Factor of the environment's rewards; 0 learns from the other streams alone."""
    gamma: Optional[float] = None
    """Discount of the environment's rewards; null: as ppo.gamma."""

    def __post_init__(self) -> None:
        at_least("rewards.extrinsic.strength", self.strength, 0)
        if self.gamma is not None:
            within("rewards.extrinsic.gamma", self.gamma, 0, 1)


@dataclass
class IntrinsicConfig:
    """A stream of rewards that a model of its own gives."""

    strength: float = 0.0
    """Factor of the reward; 0: this stream is off."""
    steps: int = 0
    """Agent decisions over which the strength falls to 0, so that what is learnt in the end is for the
    environment's rewards alone; 0: it stays."""
    gamma: float = 0.99
    """Discount of the reward."""
    lr: float = 3e-4
    """Learning rate of the stream's model."""
    hidden: list[int] = field(default_factory=lambda: [128, 128])
    """Widths of the model's layers."""
    normalize: bool = True
    """Divide the reward by the running deviation of its discounted sums; false: as it is (ML-Agents)."""

    _section = ""

    def __post_init__(self) -> None:
        at_least(f"{self._section}.strength", self.strength, 0)
        at_least(f"{self._section}.steps", self.steps, 0)
        within(f"{self._section}.gamma", self.gamma, 0, 1)
        above(f"{self._section}.lr", self.lr, 0)
        widths(f"{self._section}.hidden", self.hidden)


@dataclass
class CuriosityConfig(IntrinsicConfig):
    """Reward for what a model of the environment does not foresee (ICM, arXiv 1705.05363)."""

    _section = "rewards.curiosity"


@dataclass
class RNDConfig(IntrinsicConfig):
    """Reward for observations that are new (random network distillation, arXiv 1810.12894)."""

    lr: float = 1e-4
    _section = "rewards.rnd"


@dataclass
class GAILConfig(IntrinsicConfig):
    """Reward for what a discriminator takes for the demonstrations' (GAIL, arXiv 1606.03476)."""

    normalize: bool = False
    demos: list[str] = field(default_factory=list)
    """Unity's .demo files, or folders of them."""
    use_actions: bool = False
    """Judge observations with actions and ends; false: observations alone."""
    use_vail: bool = False
    """Let the discriminator see features through a bottleneck (VAIL, arXiv 1810.00821)."""
    _section = "rewards.gail"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.strength > 0 and not self.demos:
            raise ConfigError(
                f"rewards.gail.strength={self.strength:g} needs demonstrations: "
                "rewards.gail.demos=[expert.demo]"
            )


@dataclass
class BCConfig:
    """Behavioral cloning: the policy learns to do what demonstrations show."""

    demos: list[str] = field(default_factory=list)
    """Unity's .demo files, or folders of them; none: nothing is cloned."""
    strength: float = 1.0
    """Learning rate of cloning in units of the policy's (ppo.lr)."""
    steps: int = 0
    """Agent decisions over which the strength falls to 0; 0: it stays."""
    only: bool = False
    """Learn from the demonstrations alone: they are played back instead of the environment, which is not
    opened."""

    def __post_init__(self) -> None:
        above("bc.strength", self.strength, 0)
        at_least("bc.steps", self.steps, 0)
        if self.only and self.steps:
            raise ConfigError(f"bc.steps={self.steps} does not go with bc.only=true: nothing would be left")


@dataclass
class RewardsConfig:
    """Streams of rewards, each with a discount and a value of its own; their advantages are summed."""

    extrinsic: ExtrinsicConfig = field(default_factory=ExtrinsicConfig)
    """The environment's own rewards."""
    curiosity: CuriosityConfig = field(default_factory=CuriosityConfig)
    """Reward for what a model of the environment does not foresee."""
    rnd: RNDConfig = field(default_factory=RNDConfig)
    """Reward for observations that are new."""
    gail: GAILConfig = field(default_factory=GAILConfig)
    """Reward for what a discriminator takes for the demonstrations'."""

    @property
    def intrinsic(self) -> dict[str, IntrinsicConfig]:
        """The streams beside the environment's that are on, by name."""
        streams: dict[str, IntrinsicConfig] = {
            "curiosity": self.curiosity,
            "rnd": self.rnd,
            "gail": self.gail,
        }
        return {name: stream for name, stream in streams.items() if stream.strength > 0}
