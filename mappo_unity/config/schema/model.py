"""Options of the networks: `model.*`."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, fields
from enum import Enum
from typing import Any, Optional

from mappo_unity.config.schema.checks import at_least, between, widths, within
from mappo_unity.errors import ConfigError


class Activation(Enum):
    """Nonlinearity between hidden layers."""

    tanh = "tanh"
    relu = "relu"
    silu = "silu"
    elu = "elu"


class CriticKind(Enum):
    """What the critic of an agent sees."""

    local = "local"
    central = "central"
    mean = "mean"
    attention = "attention"
    poca = "poca"


class MemoryKind(Enum):
    """The memory of a network."""

    none = "none"
    lstm = "lstm"
    gru = "gru"


class ImageKind(Enum):
    """Layers between an image and its features."""

    auto = "auto"
    simple = "simple"
    nature = "nature"
    resnet = "resnet"
    match3 = "match3"
    dense = "dense"
    grid = "grid"


class GoalKind(Enum):
    """How goal signals reach a network."""

    none = "none"
    hyper = "hyper"


class WeightInit(Enum):
    """Initial weights of linear layers; biases are 0."""

    orthogonal = "orthogonal"
    kaiming_normal = "kaiming_normal"


class DistributionKind(Enum):
    """Distribution of continuous actions."""

    gaussian = "gaussian"
    tanh_normal = "tanh_normal"


LOG_STD_RANGE = (-5, 2)
"""Of the logarithm of the standard deviation of continuous actions, before the division by 3."""


def bounded_log_std(value: float) -> float:
    """Return the value in `LOG_STD_RANGE` of the same effect as an older run's, which might lie beyond."""
    return min(max(value, LOG_STD_RANGE[0]), LOG_STD_RANGE[1])


WITHOUT_MIRROR = "model.mirror.use=false does without"
"""What to do where networks cannot mirror."""


@dataclass
class MirrorConfig:
    """What an agent senses and does, in a mirror that exchanges left and right; with nothing given: unused.

    Columns are those of the vector observations, all sensors in one, counted from 0. Where a network mirrors,
    it acts in the mirror image of a situation as the mirror image of how it acts in that situation.
    """

    use: bool = True
    """Whether networks mirror, where a mirror image is described; false: presets' descriptions are left
    aside."""
    rays: list[int] = field(default_factory=list)
    """Ray sensors of Unity, four numbers each: first column, rays, numbers of a ray (tags + 2), stacked
    frames; rays to the right and to the left change places."""
    swap: list[int] = field(default_factory=list)
    """Runs of columns that change places, three numbers each: first column of the one, first column of the
    other, length."""
    negate: list[int] = field(default_factory=list)
    """Columns that change their sign; of two that change places, both."""
    flip_images: bool = False
    """Images and grids have a mirror image, too: their columns of pixels or cells in reverse order."""
    swap_actions: list[int] = field(default_factory=list)
    """Continuous actions that change places, two numbers each."""
    negate_actions: list[int] = field(default_factory=list)
    """Continuous actions that change their sign; of two that change places, both."""
    branches: list[int] = field(default_factory=list)
    """Of each discrete action the one that takes its place, branch after branch: [0, 2, 1] for a branch of
    none, left, right; no numbers: all stay."""

    def __post_init__(self) -> None:
        for name, group in (("rays", 4), ("swap", 3), ("swap_actions", 2)):
            numbers = getattr(self, name)
            if len(numbers) % group:
                raise ConfigError(
                    f"model.mirror.{name}={show_numbers(numbers)} holds {len(numbers)} numbers; it takes "
                    f"{group} for each entry"
                )
        for name, numbers in self.lists().items():
            if any(number < 0 for number in numbers):
                raise ConfigError(f"model.mirror.{name}={show_numbers(numbers)} must hold numbers from 0 on")

    def lists(self) -> dict[str, list[int]]:
        """Return the options that are lists of numbers, by their names."""
        values = {each.name: getattr(self, each.name) for each in fields(self)}
        return {name: value for name, value in values.items() if isinstance(value, list)}

    @property
    def is_used(self) -> bool:
        """Whether there is a mirror image."""
        return self.use and (self.flip_images or any(self.lists().values()))

    @property
    def in_effect(self) -> MirrorConfig:
        """What of it matters: itself, or nothing where it is not used."""
        return self if self.is_used else MirrorConfig()


def show_mirror(options: dict[str, Any]) -> str:
    """Return what is given of `MirrorConfig`, which stands there as plain values, in a few words."""
    mirror = asdict(MirrorConfig(**options).in_effect)
    given = {name: value for name, value in mirror.items() if value and name != "use"}
    shown = (f"{name}={'true' if value is True else show_numbers(value)}" for name, value in given.items())
    return f"({' '.join(shown)})" if given else "none"


def show_numbers(numbers: list[int]) -> str:
    """Return numbers as they are given; of many the first ones."""
    shown = ", ".join(map(str, numbers[:8]))
    return f"[{shown}, ...]" if len(numbers) > 8 else f"[{shown}]"


@dataclass
class ModelConfig:
    """The actor's and the critic's networks."""

    hidden: list[int] = field(default_factory=lambda: [128, 128])
    """Widths of the hidden layers."""
    critic_hidden: Optional[list[int]] = None
    """Widths of the critic's hidden layers; null: as model.hidden."""
    activation: Activation = Activation.tanh
    """Nonlinearity between hidden layers."""
    critic: CriticKind = CriticKind.central
    """What an agent's critic sees: its own observation (local: IPPO), its team's concatenated (central:
    MAPPO), or its team's pooled (mean, attention: for teams whose size varies). poca: MA-POCA's value of the
    team, and a baseline for each member that knows its mates' actions."""
    share_parameters: bool = True
    """One network for all members of a team; false: one for each member."""
    flatten_branches: bool = False
    """One categorical over all combinations of the discrete branches, instead of one for each branch."""
    normalize_obs: bool = True
    """Normalise observations by running mean and variance, inside the network."""
    obs_norm_prior: bool = False
    """Let the running mean and variance of observations begin with one pseudo-observation of mean 0 and
    variance 1, as ML-Agents does, instead of with nothing."""
    layer_norm: bool = False
    """Layer normalisation of vector observations and after each hidden activation, as in the MAPPO paper."""
    weight_init: WeightInit = WeightInit.orthogonal
    """Initial weights: orthogonal with gain sqrt 2, output layers 0.01 (orthogonal), or ML-Agents' He normal
    with gain 1, means 0.2, branches 0.1, a value layer Xavier uniform (kaiming_normal)."""
    action_distribution: DistributionKind = DistributionKind.gaussian
    """Continuous actions: a Gaussian that the environment clips, its deviation a weight of its own
    (gaussian), or a Gaussian squashed by tanh, its deviation an output of the network (tanh_normal)."""
    image_encoder: ImageKind = ImageKind.auto
    """Encoder of images and grids: ML-Agents' simple (from 20 x 20 on), nature (36), resnet (15), match3 (5)
    or dense (any size), with as many features as the first hidden layer is wide; auto: convolutions that fit
    the size, 128 features; grid (11): convolutions of short steps, 128 features, for grid sensors, each cell
    of which counts."""
    goal_conditioning: GoalKind = GoalKind.none
    """Sensors that are goal signals: observations like others (none), and, as ML-Agents' default has it, what
    another network makes the weights of the last hidden layer of (hyper; actors and local critics)."""
    memory: MemoryKind = MemoryKind.none
    """Memory of the actor and the critic: lstm or gru, one layer before the heads; none: they see the newest
    observation only."""
    memory_size: int = 128
    """Width of the memory's state (as in ML-Agents: an LSTM's hidden and cell state are half as wide)."""
    critic_traces: list[float] = field(default_factory=list)
    """Let the critic remember: decays, between 0 and 1, of moving averages of each agent's vector
    observations over its episode, such as [0.8, 0.95]; none: it sees the newest ones alone."""
    critic_traced: list[int] = field(default_factory=list)
    """Columns of the vector observations, all sensors in one, that model.critic_traces averages: runs, of two
    numbers each, first column and length; none: all."""
    mirror: MirrorConfig = field(default_factory=MirrorConfig)
    """Networks for which left and right are the same game, of the one as of the other (docs/mirror.md)."""
    init_log_std: float = 0.0
    """Logarithm of the initial standard deviation of continuous actions (before the division by 3; with
    tanh_normal before tanh), from -5 to 2, where training keeps it."""

    def __post_init__(self) -> None:
        widths("model.hidden", self.hidden)
        widths("model.critic_hidden", self.critic_hidden or [1])  # null and [] mean model.hidden

        at_least("model.memory_size", self.memory_size, 1)
        if self.memory is MemoryKind.lstm and self.memory_size % 2:
            raise ConfigError(
                f"model.memory_size={self.memory_size} must be even with model.memory=lstm: half of it is "
                f"the hidden state, half the cell state; model.memory_size={self.memory_size + 1}"
            )
        if self.memory is not MemoryKind.none and not self.share_parameters:
            raise ConfigError(
                f"model.memory={self.memory.value} needs model.share_parameters=true: networks of each "
                "member of a team have no memory yet"
            )

        if self.critic is CriticKind.poca and not self.share_parameters:
            raise ConfigError(
                "model.critic=poca needs model.share_parameters=true: its value is the whole team's"
            )

        self._check_traced()
        if self.mirror.is_used:
            self._check_mirrored()

        within("model.init_log_std", self.init_log_std, *LOG_STD_RANGE)

    def columns_traced(self, vector: int) -> list[int]:
        """Return the columns that `critic_traces` averages, of `vector` columns.

        Raises:
            ConfigError: they have no such column, or there are none.
        """
        begins, lengths = self.critic_traced[::2], self.critic_traced[1::2]
        runs = list(zip(begins, lengths)) or [(0, vector)]
        columns = [column for begin, length in runs for column in range(begin, begin + length)]
        if not vector:
            raise ConfigError(
                f"model.critic_traces={list(self.critic_traces)} averages vector observations, of which "
                "there are none; give model.critic_traces=[]"
            )
        if max(columns) >= vector:
            raise ConfigError(
                f"model.critic_traced={show_numbers(self.critic_traced)} names column {max(columns)}; there "
                f"are {vector} columns of vector observations, counted from 0; model.critic_traces=[] does "
                "without"
            )
        return columns

    def _check_traced(self) -> None:
        for decay in self.critic_traces:
            between("model.critic_traces", decay, 0, 1)

        numbers = self.critic_traced
        if len(numbers) % 2 or any(n < 0 for n in numbers[::2]) or any(n < 1 for n in numbers[1::2]):
            raise ConfigError(
                f"model.critic_traced={show_numbers(numbers)} must hold runs of columns, two numbers each: "
                "the first column, from 0 on, and how many, from 1 on"
            )

    def _check_mirrored(self) -> None:
        for option, value, needed in (
            ("memory", self.memory, MemoryKind.none),
            ("flatten_branches", self.flatten_branches, False),
            ("critic_traces", list(self.critic_traces), []),
        ):
            if value != needed:
                raise ConfigError(
                    f"model.mirror needs model.{option}={_show(needed)}, not {_show(value)}: what that looks "
                    f"like in a mirror is not known; {WITHOUT_MIRROR}"
                )
        if self.critic is CriticKind.poca:
            raise ConfigError(
                "model.mirror needs model.critic=local, central, mean or attention, not poca: its baseline "
                f"sees actions, which are not mirrored there; {WITHOUT_MIRROR}"
            )


def _show(value: object) -> str:
    return str(value.value) if isinstance(value, Enum) else str(value).lower()
