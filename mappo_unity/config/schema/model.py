"""Options of the networks: `model.*`."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum
from typing import Any, Optional

from omegaconf import DictConfig

from mappo_unity.config.schema.checks import at_least, between, widths, within
from mappo_unity.config.schema.mirror import WITHOUT_MIRROR, MirrorConfig, show_numbers
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
    traces = "traces"


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
    """Memory of the actor and the critic: lstm or gru, one layer before the heads, which is learnt on
    sequences; traces, moving averages of what the agent has observed, where nothing is; none: they see the
    newest observation only."""
    memory_size: int = 128
    """Width of the memory's state (as in ML-Agents: an LSTM's hidden and cell state are half as wide)."""
    memory_traces: list[float] = field(default_factory=lambda: [0.8, 0.95])
    """With model.memory=traces: decays, between 0 and 1, of the moving averages of the agent's vector
    observations over its episode; 0.95 averages about 20 decisions."""
    memory_traced: list[int] = field(default_factory=list)
    """Columns of the vector observations, all sensors in one, that model.memory_traces averages: runs, of two
    numbers each, first column and length; none: all."""
    critic_traces: list[float] = field(default_factory=list)
    """Let the critic remember: decays, between 0 and 1, of moving averages of each agent's vector
    observations over its episode, such as [0.8, 0.95]; none: those of the actor, if it has any."""
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

        self._check_traces()
        if self.mirror.is_used:
            self._check_mirrored()

        within("model.init_log_std", self.init_log_std, *LOG_STD_RANGE)

    @property
    def is_recurrent(self) -> bool:
        """Whether the memory is a layer that is learnt on sequences."""
        return self.memory in (MemoryKind.lstm, MemoryKind.gru)

    def traces_of_actor(self, vector: int) -> tuple[list[float], list[int]]:
        """Return the decays of what the actor averages, and the columns, of `vector` columns; none: nothing.

        Raises:
            ConfigError: they have no such column, or there are none.
        """
        if self.memory is not MemoryKind.traces:
            return [], []
        return self.memory_traces, self._columns("memory", vector, "model.memory=none")

    def traces_of_critic(self, vector: int) -> tuple[list[float], list[int]]:
        """Return the same of the critic; raises ConfigError likewise."""
        if not self.critic_traces:
            return self.traces_of_actor(vector)
        return self.critic_traces, self._columns("critic", vector, "model.critic_traces=[]")

    def _columns(self, whose: str, vector: int, without: str) -> list[int]:
        numbers: list[int] = getattr(self, f"{whose}_traced")
        runs = list(zip(numbers[::2], numbers[1::2])) or [(0, vector)]
        columns = [column for begin, length in runs for column in range(begin, begin + length)]
        if not vector:
            raise ConfigError(
                f"model.{whose}_traces={list(getattr(self, f'{whose}_traces'))} averages vector "
                f"observations, of which there are none; give {without}"
            )
        if max(columns) >= vector:
            raise ConfigError(
                f"model.{whose}_traced={show_numbers(numbers)} names column {max(columns)}; there are "
                f"{vector} columns of vector observations, counted from 0; {without} does without"
            )
        return columns

    def _check_traces(self) -> None:
        for whose in ("memory", "critic"):
            for decay in getattr(self, f"{whose}_traces"):
                between(f"model.{whose}_traces", decay, 0, 1)

            numbers: list[int] = getattr(self, f"{whose}_traced")
            if len(numbers) % 2 or any(n < 0 for n in numbers[::2]) or any(n < 1 for n in numbers[1::2]):
                raise ConfigError(
                    f"model.{whose}_traced={show_numbers(numbers)} must hold runs of columns, two numbers "
                    "each: the first column, from 0 on, and how many, from 1 on"
                )
        if self.memory is MemoryKind.traces and not self.memory_traces:
            raise ConfigError(
                "model.memory_traces=[] leaves nothing to model.memory=traces; give decays, such as "
                "[0.8, 0.95], or model.memory=none"
            )

    def _check_mirrored(self) -> None:
        for why in without_mirror_image(self).values():
            raise ConfigError(f"model.mirror needs {why}; {WITHOUT_MIRROR}")
        if self.mirror.handed:
            for why in without_preferred_side(self).values():
                raise ConfigError(
                    f"model.mirror.handed=true needs {why}; model.mirror.handed=false does without"
                )


def without_mirror_image(model: Any) -> dict[str, str]:
    """Return the options that networks which mirror cannot have, by name, and what they need instead.

    Args:
        model: a `ModelConfig`, or a tree that one is made of.
    """
    out = {}
    unknown = "what that looks like in a mirror is not known"
    if model.memory in (MemoryKind.lstm, MemoryKind.gru):
        out["memory"] = f"model.memory=none or traces, not {model.memory.value}: {unknown}"
    if model.flatten_branches:
        out["flatten_branches"] = f"model.flatten_branches=false, not true: {unknown}"
    if model.critic is CriticKind.poca:
        out["critic"] = (
            "model.critic=local, central, mean or attention, not poca: its baseline sees actions, which are "
            "not mirrored there"
        )
    return out


def without_preferred_side(model: Any) -> dict[str, str]:
    """Return the options that networks which mirror and prefer a side cannot have; see above."""
    if model.goal_conditioning is GoalKind.none:
        return {}
    return {
        "goal_conditioning": f"model.goal_conditioning=none, not {model.goal_conditioning.value}: goals may "
        "make the layer that prefers a side"
    }


def let_mirror_give_way(tree: DictConfig, given: list[str]) -> None:
    """Let a preset's mirror give way where the command line asks for what has no mirror image.

    Where it asks for what cannot prefer a side, only that gives way. Whoever describes a mirror there as well
    is told so by the checks of `ModelConfig`.

    Args:
        tree: options that a `Config` is made of, changed in place.
        given: full names of the options that the command line sets.
    """
    if any("model.mirror" in name for name in given):
        return

    model = tree.model
    if any(f"model.{option}" in given for option in without_mirror_image(model)):
        model.mirror.use = False
    if any(f"model.{option}" in given for option in without_preferred_side(model)):
        model.mirror.handed = False
