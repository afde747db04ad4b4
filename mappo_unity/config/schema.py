"""Every option, as one dataclass field with its type, default and description.

Values are checked when `Config` and its sections are built. This module must stay importable without torch,
so that ``--help`` and errors about options come at once.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field
from enum import Enum
from typing import Any, Optional

from mappo_unity.config.parameters.values import FACTORY, PLAYERS, SCENE, curricula, read_parameters
from mappo_unity.errors import ConfigError


class Backend(Enum):
    """What runs the environment."""

    embedded = "embedded"
    custom = "custom"
    pettingzoo = "pettingzoo"
    player = "player"
    editor = "editor"
    registry = "registry"


BACKENDS = "backends"
"""Metadata of an option of env: the backends that look at it; without it all do."""
_STARTED = {BACKENDS: (Backend.player, Backend.registry)}
_UNITY = {BACKENDS: (Backend.player, Backend.editor, Backend.registry)}
_ANY_BUT_CUSTOM = {BACKENDS: tuple(backend for backend in Backend if backend is not Backend.custom)}
_FACTORY = {BACKENDS: (Backend.custom, Backend.pettingzoo)}


class Activation(Enum):
    """Nonlinearity between hidden layers."""

    tanh = "tanh"
    relu = "relu"
    silu = "silu"
    elu = "elu"


class Optimizer(Enum):
    """Optimizer of the networks."""

    adam = "adam"
    adamw = "adamw"


class Schedule(Enum):
    """How a quantity moves from its start to its end over `max_steps`."""

    constant = "constant"
    linear = "linear"
    cosine = "cosine"


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


class GoalKind(Enum):
    """How goal signals reach a network."""

    none = "none"
    hyper = "hyper"


class RatioKind(Enum):
    """What the probability ratio is taken of and clipped for."""

    joint = "joint"
    component = "component"


class ObjectiveKind(Enum):
    """What the probability ratio compares the policy with."""

    clip = "clip"
    decoupled = "decoupled"


class AdvantageKind(Enum):
    """How advantages and value targets are estimated."""

    gae = "gae"
    vtrace = "vtrace"


class EntropyKind(Enum):
    """How the entropies of continuous columns become one."""

    sum = "sum"
    mean = "mean"


class ValueNormUpdate(Enum):
    """When the statistics of returns move."""

    batch = "batch"
    minibatch = "minibatch"


class ObsNormUpdate(Enum):
    """When the statistics of observations move."""

    batch = "batch"
    round = "round"


class WeightInit(Enum):
    """Initial weights of linear layers; biases are 0."""

    orthogonal = "orthogonal"
    kaiming_normal = "kaiming_normal"


class DistributionKind(Enum):
    """Distribution of continuous actions."""

    gaussian = "gaussian"
    tanh_normal = "tanh_normal"


class ValueNormKind(Enum):
    """How the critic's targets are normalised."""

    none = "none"
    running = "running"
    popart = "popart"


class ValueLoss(Enum):
    """Distance between the critic's output and its target."""

    huber = "huber"
    mse = "mse"


class TagKind(Enum):
    """How curves are named on TensorBoard."""

    own = "own"
    mlagents = "mlagents"


class LoggerKind(Enum):
    """Where metrics go besides ``metrics.csv``."""

    csv = "csv"
    tensorboard = "tensorboard"
    wandb = "wandb"
    mlflow = "mlflow"


@dataclass
class EnvConfig:
    """The environment."""

    name: str = "3DBall"
    """Name of the environment: a preset in conf/env, also the name of the run's folder."""
    backend: Backend = Backend.embedded
    """What runs it: an embedded scene, a simulator of your own (custom), a PettingZoo parallel environment, a
    built Unity player, the Unity Editor, or a player that ML-Agents' registry names (registry)."""
    num_areas: Optional[int] = field(default=None, metadata=_ANY_BUT_CUSTOM)
    """Copies of the playing area inside one environment; null: as many as the Unity scene has."""
    params: dict[str, Any] = field(default_factory=dict)
    """Environment parameters (env.params.mass=2) of the scene or player, or arguments of env.factory. Also a
    sampler, {sampler: uniform, min: 0.5, max: 10}, or a curriculum, {lessons: [...]}."""
    factory: Optional[str] = field(default=None, metadata=_FACTORY)
    """With backend=custom or pettingzoo: package.module:function, called as function(seed=..., **env.params);
    with pettingzoo the seed only if it takes one."""
    teams: str = field(default="all", metadata={BACKENDS: (Backend.pettingzoo,)})
    """With backend=pettingzoo, who shares a team: all, none, or package.module:function, called with an
    agent's name, which returns its team (a whole number or a text; None: alone)."""
    file_name: Optional[str] = field(default=None, metadata={BACKENDS: (Backend.player,)})
    """With backend=player: path of the built Unity player, with or without its extension."""
    registry: str = field(default="default", metadata={BACKENDS: (Backend.registry,)})
    """With backend=registry: path or URL of a registry's YAML file, or default (ML-Agents' own)."""
    registry_entry: Optional[str] = field(default=None, metadata={BACKENDS: (Backend.registry,)})
    """With backend=registry: the entry to play; null: the one called env.name."""
    num_players: int = field(default=1, metadata=_STARTED)
    """Players that run side by side, their agents in one batch."""
    max_restarts: int = field(default=20, metadata=_UNITY)
    """Times that each player is started again in a run after it crashed, hung or sent nonsense; and each
    worker's process (collect.workers)."""
    timeout_s: float = field(default=60.0, metadata=_UNITY)
    """Seconds within which a player (or the Editor) must connect, and must answer."""
    port: Optional[int] = field(default=None, metadata={BACKENDS: (Backend.editor,)})
    """With backend=editor: the port to wait on; null: 5004, as in Unity. Players get free ports."""
    time_scale: float = field(default=20.0, metadata=_UNITY)
    """How much faster than real time a player runs; a high one may change its physics."""
    quality_level: Optional[int] = field(default=None, metadata=_UNITY)
    """Unity's quality level; null: as built."""
    screen_width: Optional[int] = field(default=None, metadata=_UNITY)
    """Width of a player's screen in pixels; null: as built."""
    screen_height: Optional[int] = field(default=None, metadata=_UNITY)
    """Height of a player's screen in pixels; null: as built."""
    target_frame_rate: Optional[int] = field(default=-1, metadata=_UNITY)
    """Frames a second that a player draws; -1: no limit, null: as built."""
    no_graphics: bool = field(default=False, metadata=_STARTED)
    """Start players without graphics (machines without a display); cameras then see nothing."""
    player_args: list[str] = field(default_factory=list, metadata=_STARTED)
    """Further arguments of a player's command line."""
    player_logs: Optional[str] = field(default=None, metadata=_STARTED)
    """Folder of the players' logs; null: players/ in the run's folder."""
    max_team_size: Optional[int] = None
    """Agent slots of a team; null: the largest team seen at the start."""
    max_teams: Optional[int] = None
    """Team slots of a behavior; null: as many as are seen at the start."""
    note: Optional[str] = None
    """Said when a training run begins: what the environment needs and the trainer does not have."""

    def __post_init__(self) -> None:
        if not re.fullmatch(r"[\w.-]*\w[\w.-]*", self.name):
            raise ConfigError(
                f"env.name={self.name!r} must consist of letters, digits, '_', '-' and '.': it names a folder"
            )

        _at_least("env.num_areas", self.num_areas, 1)
        _at_least("env.max_team_size", self.max_team_size, 1)
        _at_least("env.max_teams", self.max_teams, 1)
        _at_least("env.num_players", self.num_players, 1)
        _at_least("env.max_restarts", self.max_restarts, 0)
        _above("env.timeout_s", self.timeout_s, 0)
        _above("env.time_scale", self.time_scale, 0)
        _at_least("env.quality_level", self.quality_level, 0)
        _at_least("env.screen_width", self.screen_width, 1)
        _at_least("env.screen_height", self.screen_height, 1)
        _at_least("env.target_frame_rate", self.target_frame_rate, -1)
        if self.port is not None:
            _within("env.port", self.port, 1, 65535)

        self._check_players()
        _ = self.parameters  # which looks for mistakes

        if self.backend in (Backend.custom, Backend.pettingzoo) and not self.factory:
            kind = "BaseEnv" if self.backend is Backend.custom else "pettingzoo.ParallelEnv"
            raise ConfigError(
                f"env.factory is not given, but env.backend={self.backend.value} needs it: "
                f"env.factory=package.module:function, a function that returns a {kind}"
            )
        if self.factory is not None and self.factory.count(":") != 1:
            raise ConfigError(f"env.factory={self.factory!r} is not of the form package.module:function")
        if self.teams not in ("all", "none") and self.teams.count(":") != 1:
            raise ConfigError(
                f"env.teams={self.teams!r} must be all, none, or a function, package.module:function"
            )

    def _check_players(self) -> None:
        if self.backend is Backend.player and not self.file_name:
            raise ConfigError(
                "env.file_name is not given, but env.backend=player needs it: the path of a built Unity "
                "player, env.file_name=builds/Game (env.backend=editor trains in the Unity Editor instead)"
            )

        if (self.screen_width is None) != (self.screen_height is None):
            raise ConfigError("env.screen_width and env.screen_height belong together: give both or neither")

        if self.backend not in (Backend.player, Backend.registry) and self.num_players > 1:
            has_areas = self.backend in (Backend.embedded, Backend.pettingzoo)
            larger = " (env.num_areas makes it larger)" if has_areas else ""
            raise ConfigError(
                f"env.num_players={self.num_players} needs env.backend=player or registry; with "
                f"env.backend={self.backend.value} there is one environment{larger}"
            )

    @property
    def parameters(self) -> dict[str, Any]:
        """What env.params says, read: see `read_parameters`; raises ConfigError."""
        takers = {Backend.embedded: SCENE, Backend.custom: FACTORY, Backend.pettingzoo: FACTORY}
        return read_parameters(self.params, takers.get(self.backend, PLAYERS))


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
    the size, 128 features."""
    goal_conditioning: GoalKind = GoalKind.none
    """Sensors that are goal signals: observations like others (none), and, as ML-Agents' default has it, what
    another network makes the weights of the last hidden layer of (hyper; actors and local critics)."""
    memory: MemoryKind = MemoryKind.none
    """Memory of the actor and the critic: lstm or gru, one layer before the heads; none: they see the newest
    observation only."""
    memory_size: int = 128
    """Width of the memory's state (as in ML-Agents: an LSTM's hidden and cell state are half as wide)."""
    init_log_std: float = 0.0
    """Logarithm of the initial standard deviation of continuous actions (before the division by 3; with
    tanh_normal before tanh), from -5 to 2, where training keeps it."""

    def __post_init__(self) -> None:
        _check_widths("model.hidden", self.hidden)
        _check_widths("model.critic_hidden", self.critic_hidden or [1])  # null and [] mean model.hidden

        _at_least("model.memory_size", self.memory_size, 1)
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

        _within("model.init_log_std", self.init_log_std, *LOG_STD_RANGE)


@dataclass
class PPOConfig:
    """The learner."""

    lr: float = 3e-4
    """Learning rate at the start."""
    lr_schedule: Schedule = Schedule.linear
    """How the learning rate falls to ppo.lr_final over max_steps."""
    lr_final: float = 0.0
    """Learning rate at the end of its schedule."""
    schedules_count_batch: bool = False
    """Whether schedules count the decisions of the batch that is learnt, so that the last one is learnt with
    the final values (as ML-Agents), or only those before it."""
    critic_lr: Optional[float] = None
    """Learning rate of the critic at the start, with the schedule of ppo.lr; null: as ppo.lr."""
    separate_optimizers: bool = False
    """Clip the gradients of actor and critic apart, as two optimizers would; false: one norm over both."""
    optimizer: Optimizer = Optimizer.adam
    """Optimizer of the networks."""
    optimizer_eps: float = 1e-5
    """Epsilon of the optimizer, which keeps steps small where gradients are tiny."""
    weight_decay: float = 0.0
    """Weight decay of the optimizer."""
    gamma: float = 0.99
    """Discount of a decision."""
    gae_lambda: float = 0.95
    """Lambda of generalised advantage estimation."""
    advantage: AdvantageKind = AdvantageKind.gae
    """How advantages are estimated: as if the policy had collected the batch itself (gae), or corrected for
    what an older one did (vtrace), see collect.overlap."""
    time_horizon: Optional[int] = None
    """Decisions of an agent after which its advantages are cut, and a value stands for the rest (as in
    ML-Agents); null: they are cut only where a batch ends."""
    clip_epsilon: float = 0.2
    """Half-width of the ratio's clipping interval at the start."""
    clip_schedule: Schedule = Schedule.constant
    """How the clipping interval falls to ppo.clip_epsilon_final over max_steps."""
    clip_epsilon_final: float = 0.1
    """Clipping interval at the end of its schedule."""
    ratio: RatioKind = RatioKind.joint
    """The probability ratio that is clipped: of the whole action (joint), or of each continuous column and
    each branch by itself, averaged (component, as ML-Agents)."""
    objective: ObjectiveKind = ObjectiveKind.clip
    """What the ratio, its clipping and the KL limits compare the policy with: the one that collected the
    batch (clip), or the one that the update began with, beside importance weights (decoupled), see
    collect.overlap."""
    epochs: int = 3
    """Passes over a batch."""
    minibatch_size: int = 1024
    """Agent decisions in a minibatch, about; an epoch has as many minibatches as come nearest to it."""
    sequence_length: int = 64
    """With model.memory: decisions of an agent that are learnt in a row."""
    num_minibatches: Optional[int] = None
    """Minibatches of an epoch, instead of ppo.minibatch_size; null: as that says."""
    entropy_coef: float = 0.0
    """Weight of the entropy bonus at the start."""
    entropy_schedule: Schedule = Schedule.linear
    """How the entropy weight falls to ppo.entropy_coef_final over max_steps."""
    entropy_coef_final: float = 0.0
    """Entropy weight at the end of its schedule."""
    entropy: EntropyKind = EntropyKind.sum
    """How the entropies of continuous columns become one: their sum, or their mean (as ML-Agents)."""
    value_coef: float = 0.5
    """Weight of the value loss."""
    value_loss: ValueLoss = ValueLoss.huber
    """Distance between the critic's output and its target."""
    huber_delta: float = 10.0
    """Where the Huber loss turns linear, in units of the critic's (normalised) output."""
    clip_value: bool = False
    """Clip the move of the critic's output by the clipping interval."""
    normalize_values: ValueNormKind = ValueNormKind.popart
    """The critic learns returns normalised by running statistics; popart also rescales its last layer
    when they move, so that its values stay what they were."""
    value_norm_beta: float = 0.99
    """Decay, for each batch, of the running statistics of returns."""
    value_norm_update: ValueNormUpdate = ValueNormUpdate.batch
    """When these statistics move: once for each batch, or with each minibatch (the MAPPO paper's code)."""
    obs_norm_update: ObsNormUpdate = ObsNormUpdate.batch
    """With model.normalize_obs: when its statistics move, once for each batch, after its update (batch), or
    while it is collected, with each round (round: ML-Agents moves them with each trajectory)."""
    reward_weight: float = 1.0
    """Weight of an agent's individual reward."""
    group_reward_weight: float = 1.0
    """Weight of its team's reward."""
    death_masking: bool = True
    """A member that ended while its team plays on keeps earning the team's reward until the team ends."""
    critic_warmup_steps: int = 0
    """Agent decisions until which only the critic learns, so that a new one does not spoil a trained actor
    (init_from)."""
    normalize_advantages: bool = True
    """Normalise advantages over the acting agents of a batch."""
    max_grad_norm: Optional[float] = 0.5
    """Gradients are scaled down to this norm; null: never (ML-Agents)."""
    target_kl: Optional[float] = None
    """Stop an update's remaining epochs when the approximate KL exceeds this; null: never."""
    max_kl: float = 1.0
    """Roll an update back when the approximate KL exceeds this or a number is not finite."""
    compile: bool = False
    """Let torch.compile compile the networks for the update, which takes half a minute at the start; not
    with model.memory. Meant for GPUs: on a CPU it gains little."""

    def __post_init__(self) -> None:
        _above("ppo.lr", self.lr, 0)
        _above("ppo.critic_lr", self.critic_lr, 0)
        _at_least("ppo.sequence_length", self.sequence_length, 1)
        _at_least("ppo.lr_final", self.lr_final, 0)
        _above("ppo.optimizer_eps", self.optimizer_eps, 0)
        _at_least("ppo.weight_decay", self.weight_decay, 0)
        _within("ppo.gamma", self.gamma, 0, 1)
        _within("ppo.gae_lambda", self.gae_lambda, 0, 1)
        _at_least("ppo.time_horizon", self.time_horizon, 1)
        _between("ppo.clip_epsilon", self.clip_epsilon, 0, 1)
        _between("ppo.clip_epsilon_final", self.clip_epsilon_final, 0, 1)

        _at_least("ppo.critic_warmup_steps", self.critic_warmup_steps, 0)
        _at_least("ppo.epochs", self.epochs, 1)
        _at_least("ppo.minibatch_size", self.minibatch_size, 1)
        _at_least("ppo.num_minibatches", self.num_minibatches, 1)

        _at_least("ppo.entropy_coef", self.entropy_coef, 0)
        _at_least("ppo.entropy_coef_final", self.entropy_coef_final, 0)
        _at_least("ppo.value_coef", self.value_coef, 0)
        _between("ppo.value_norm_beta", self.value_norm_beta, 0, 1)
        _above("ppo.huber_delta", self.huber_delta, 0)

        _above("ppo.max_grad_norm", self.max_grad_norm, 0)
        _above("ppo.target_kl", self.target_kl, 0)
        _above("ppo.max_kl", self.max_kl, 0)
        if (
            self.value_norm_update is ValueNormUpdate.minibatch
            and self.normalize_values is ValueNormKind.popart
        ):
            raise ConfigError(
                "ppo.value_norm_update=minibatch does not go with ppo.normalize_values=popart, which "
                "rescales the critic once for each batch; give ppo.normalize_values=running"
            )


@dataclass
class ExtrinsicConfig:
    """The environment's own rewards, individual and group reward."""

    strength: float = 1.0
    """Factor of the environment's rewards; 0 learns from the other streams alone."""
    gamma: Optional[float] = None
    """Discount of the environment's rewards; null: as ppo.gamma."""

    def __post_init__(self) -> None:
        _at_least("rewards.extrinsic.strength", self.strength, 0)
        if self.gamma is not None:
            _within("rewards.extrinsic.gamma", self.gamma, 0, 1)


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
        _at_least(f"{self._section}.strength", self.strength, 0)
        _at_least(f"{self._section}.steps", self.steps, 0)
        _within(f"{self._section}.gamma", self.gamma, 0, 1)
        _above(f"{self._section}.lr", self.lr, 0)
        _check_widths(f"{self._section}.hidden", self.hidden)


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
        _above("bc.strength", self.strength, 0)
        _at_least("bc.steps", self.steps, 0)
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


class MatmulPrecision(Enum):
    """How products of float32 matrices are computed."""

    highest = "highest"
    high = "high"
    medium = "medium"


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
        _at_least("collect.batch_size", self.batch_size, 1)
        _at_least("collect.rounds", self.rounds, 1)
        _at_least("collect.workers", self.workers, 0)
        _above("collect.timeout_s", self.timeout_s, 0)
        if self.overlap and (not self.workers or self.engine is Engine.local):
            raise ConfigError(
                "collect.overlap=true needs collect.workers=1 or more with collect.engine=processes or ray: "
                "in one process nothing is collected while it learns"
            )


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
        _at_least("self_play.save_steps", self.save_steps, 1)
        _at_least("self_play.window", self.window, 1)
        _within("self_play.play_against_latest_model_ratio", self.play_against_latest_model_ratio, 0, 1)
        _at_least("self_play.swap_steps", self.swap_steps, 0)
        _at_least("self_play.team_change", self.team_change, 1)
        _rule("self_play.initial_elo", self.initial_elo, True, "must be a finite number")
        _at_least("self_play.num_opponents", self.num_opponents, 1)
        if "" in self.fixed:
            raise ConfigError(
                "self_play.fixed has an empty entry: give random, a run folder, a checkpoint or an ONNX file"
            )

    @property
    def is_on(self) -> bool:
        """Whether there is a pool of opponents."""
        return self.save_steps is not None or bool(self.fixed)


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
        _at_least("matches.interval", self.interval, 1)
        _at_least("matches.count", self.count, 2)
        _at_least("matches.opponents", self.opponents, 0)


@dataclass
class LogConfig:
    """Metrics and progress."""

    loggers: list[LoggerKind] = field(default_factory=lambda: [LoggerKind.tensorboard])
    """Any of tensorboard, wandb, mlflow, csv (a file for each metric); metrics.csv is always written."""
    project: str = "mappo-unity"
    """Project (wandb) or experiment (mlflow) that the run is filed under."""
    return_window: int = 100
    """Finished episodes over which return_mean and its like are taken."""
    tags: TagKind = TagKind.own
    """Names of TensorBoard's curves: those of metrics.csv, by the run's agent decisions (own), or ML-Agents',
    in a folder for each behavior and by its own decisions (mlagents)."""
    summary_freq: int = 50_000
    """With tags=mlagents: decisions of a behavior between two points of its curves."""
    progress: bool = True
    """Show a live progress line on a terminal, and plain lines elsewhere."""
    dashboard: bool = False
    """Serve a page that follows the run to browsers on this machine; the address is printed at the start."""
    dashboard_port: Optional[int] = None
    """Port of the page; null: one that is free."""

    def __post_init__(self) -> None:
        _at_least("log.return_window", self.return_window, 1)
        _at_least("log.summary_freq", self.summary_freq, 1)
        if self.dashboard_port is not None:
            _within("log.dashboard_port", self.dashboard_port, 1, 65535)


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
        _within("seed", self.seed, 0, 2**31 - 1)
        _at_least("max_steps", self.max_steps, 1)
        _at_least("checkpoint_interval", self.checkpoint_interval, 1)
        _at_least("keep_checkpoints", self.keep_checkpoints, 1)
        _at_least("num_threads", self.num_threads, 1)
        _at_least("update_threads", self.update_threads, 1)
        _at_least("learners", self.learners, 1)
        _at_least("max_jobs", self.max_jobs, 1)
        _rule("stop_at_return", self.stop_at_return, True, "must be a finite number or null")

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

        change = self.self_play.team_change if self.self_play.is_on else None
        if self.collect.overlap and change is not None:
            raise ConfigError(
                f"self_play.team_change={change} does not go with collect.overlap=true: the next batch would "
                "begin before it is known that the other side learns; give collect.overlap=false"
            )

        lessons = curricula(env.parameters)
        if self.collect.overlap and lessons:
            raise ConfigError(
                f"env.params.{next(iter(lessons))} has lessons, which do not go with collect.overlap=true: "
                "the next batch would begin before its lesson is known; give collect.overlap=false"
            )
        self._check_shares(what)

    def _check_shares(self, what: str) -> None:
        """Refuse workers among which the environment cannot be shared evenly."""
        env, workers = self.env, self.collect.workers
        if env.backend is Backend.editor and workers > 1:
            raise ConfigError(f"{what} does not go with env.backend=editor: there is one Editor")

        shared: Optional[int] = None
        if env.backend in (Backend.embedded, Backend.pettingzoo):
            key, shared = "env.num_areas", env.num_areas
            if shared is None:
                raise ConfigError(f"{what} shares the areas: give env.num_areas, a multiple of {workers}")
        elif env.backend in (Backend.player, Backend.registry):
            key, shared = "env.num_players", env.num_players
        if shared is not None and shared % workers:
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


@dataclass
class EvalConfig:
    """Options of an evaluation."""

    run: str = "???"
    """Run folder (its best checkpoint is played), checkpoint, ONNX file or zoo; must be given."""
    episodes: int = 100
    """Agent episodes to play; matches, when there is an opponent."""
    opponent: Optional[str] = None
    """Play matches, both sides in turn, against random, zoo, a run folder, checkpoint or ONNX file."""
    deterministic: bool = False
    """Take the most likely action instead of a sampled one."""
    seed: int = 0
    """Seed of the environment and the sampling."""
    env: Optional[str] = None
    """Environment to play in, a preset in conf/env; null: that of the run."""

    def __post_init__(self) -> None:
        _not_empty(run=self.run, opponent=self.opponent, env=self.env)
        _at_least("episodes", self.episodes, 1)
        _within("seed", self.seed, 0, 2**31 - 1)


@dataclass
class LeagueConfig:
    """Options of a league."""

    policies: list[str] = field(default_factory=list)
    """Who plays: random, zoo, run folders (best checkpoints), checkpoints, ONNX files; before options."""
    env: Optional[str] = None
    """Environment, a preset in conf/env; null: that of the first run. env.NAME=... sets its options."""
    matches: int = 100
    """Matches of each pair, half of them with the sides swapped."""
    out: Optional[str] = None
    """Folder for the results, new or that of the same league, which goes on; null: outputs/league."""
    deterministic: bool = False
    """Take the most likely action instead of a sampled one."""
    seed: int = 0
    """Seed of the environments and the sampling."""
    workers: Optional[int] = None
    """Processes that play side by side, a pair each; null: one for each core. Results do not depend on it."""

    def __post_init__(self) -> None:
        if len(self.policies) < 2:
            raise ConfigError(
                f"a league needs two policies or more, and has {', '.join(self.policies) or 'none'}: name "
                "them before the options, mappo-league RUN_A RUN_B random env=SoccerTwos"
            )
        if "" in self.policies:
            raise ConfigError("a policy is empty: give random, a run folder, a checkpoint or an ONNX file")
        _not_empty(env=self.env, out=self.out)
        _at_least("matches", self.matches, 2)
        _within("seed", self.seed, 0, 2**31 - 1)
        _at_least("workers", self.workers, 1)


class SearchObjective(Enum):
    """What a search wants: a high return, or a goal with few decisions or in little time."""

    final_return = "final_return"
    decisions = "decisions"
    time = "time"


class Pruner(Enum):
    """Which trials of a search end early: those below the median, by successive halving, or none."""

    median = "median"
    hyperband = "hyperband"
    none = "none"


@dataclass
class SearchConfig:
    """Options of a search."""

    search: str = "???"
    """What is searched: a space in conf/search, or a YAML file of your own; must be given."""
    trials: int = 20
    """Trials in all, with those of earlier calls in the same folder."""
    workers: Optional[int] = None
    """Processes that run trials side by side, one each; null: one for each core."""
    out: Optional[str] = None
    """Folder of the search, new or that of the same search, which goes on; null: outputs/search."""
    seeds: int = 1
    """Runs of each trial, with seed, seed+1 ...; its value is their mean."""
    objective: Optional[SearchObjective] = None
    """The final mean return, or agent decisions or seconds to the goal; null: decisions, with goal."""
    goal: Optional[float] = None
    """Mean return that ends a run, for the objectives decisions and time; sets stop_at_return."""
    pruner: Pruner = Pruner.median
    """Which trials end early, by the returns of their first run (Optuna's MedianPruner, HyperbandPruner)."""

    def __post_init__(self) -> None:
        _not_empty(search=self.search, out=self.out)
        for option, value in (("trials", self.trials), ("workers", self.workers), ("seeds", self.seeds)):
            _at_least(option, value, 1)
        _rule("goal", self.goal, True, "must be finite")

        needs_goal = self.objective not in (None, SearchObjective.final_return)
        if self.objective is not None and needs_goal and self.goal is None:
            raise ConfigError(f"objective={self.objective.name} needs the return that is the goal: goal=95")
        if self.objective is SearchObjective.final_return and self.goal is not None:
            raise ConfigError(
                f"goal={self.goal:g} goes with objective=decisions or objective=time; for the best final "
                "return leave it out"
            )


@dataclass
class ExportConfig:
    """Options of an export."""

    run: str = "???"
    """Run folder (its best checkpoint is exported) or checkpoint file; must be given."""
    out: Optional[str] = None
    """File (NAME.onnx) or folder to write; null: beside the checkpoint, under its name."""
    card: bool = True
    """Write a model card beside each file, NAME.md."""
    episodes: Optional[int] = None
    """Episodes to play for the score in the card; with two sides matches against random; null: none."""
    video: bool = False
    """Film the policy for the card, NAME.mp4, in an embedded scene; extra [video]."""

    def __post_init__(self) -> None:
        _not_empty(run=self.run)
        if self.out == "":
            raise ConfigError("out= is empty: it must name a file or a folder (null: beside the checkpoint)")
        _at_least("episodes", self.episodes, 1)
        if not self.card and (self.episodes is not None or self.video):
            raise ConfigError("episodes and video=true are for the card, which card=false takes away")


@dataclass
class PushConfig:
    """Options of an upload."""

    what: str = "???"
    """Run folder or checkpoint (exported first), ONNX file or a folder of them; before the options."""
    repo: str = "???"
    """Repository on the hub, user/name; made if it is not there."""
    private: bool = False
    """Make the repository private, if it is made; one that is there stays as it is."""
    message: str = "Upload policies of mappo-unity"
    """Message of the commit."""

    def __post_init__(self) -> None:
        _not_empty(what=self.what, repo=self.repo, message=self.message)


@dataclass
class PullConfig:
    """Options of a download."""

    repo: str = "???"
    """Repository on the hub, user/name; before the options."""
    out: Optional[str] = None
    """New or empty folder to write; null: one with the name of the repository, here."""
    revision: Optional[str] = None
    """Branch, tag or commit; null: the newest of the main branch."""

    def __post_init__(self) -> None:
        _not_empty(repo=self.repo, out=self.out, revision=self.revision)


@dataclass
class PlayConfig:
    """Options of a video."""

    run: Optional[str] = None
    """Run folder (its best checkpoint is played), checkpoint or ONNX file; null: env is played by policy."""
    env: Optional[str] = None
    """Environment to play in, a preset in conf/env; null: that of the run."""
    policy: Optional[str] = None
    """With env: zoo (trained policies that the package brings), an ONNX file, or a folder with NAME.onnx for
    each behavior; null: random actions."""
    video: Optional[str] = None
    """File to write, NAME.mp4 or NAME.gif; null: a window on the display, or with record nothing."""
    record: Optional[str] = None
    """New demonstration to write, NAME.demo, or a folder for the NAME.demo of each of several behaviors."""
    seconds: float = 20.0
    """Length of the video or recording, at the scene's own pace."""
    caption: bool = True
    """Write a line into the picture: scene, time, return of the episode so far (in soccer: goals)."""
    deterministic: bool = False
    """Take the most likely action instead of a sampled one."""
    seed: int = 0
    """Seed of the environment and the sampling."""
    width: int = 960
    """Width of the picture in pixels, even."""
    height: int = 544
    """Height of the picture in pixels, even."""

    def __post_init__(self) -> None:
        _not_empty(run=self.run, env=self.env, policy=self.policy, video=self.video, record=self.record)
        _above("seconds", self.seconds, 0)
        _within("seed", self.seed, 0, 2**31 - 1)

        for option, size in (("width", self.width), ("height", self.height)):
            _rule(option, size, 64 <= size <= 4096 and size % 2 == 0, "must be even and from 64 to 4096")

        if self.run is None and self.env is None:
            raise ConfigError(
                "neither run nor env is given: run=FOLDER plays what was trained there, env=NAME random "
                "actions, env=NAME policy=FILE.onnx an ONNX file"
            )

        if self.run is not None and self.policy is not None:
            raise ConfigError(f"run={self.run} and policy={self.policy} both say who plays: give one of them")


class XAxis(Enum):
    """What curves are drawn over."""

    decisions = "decisions"
    time = "time"


@dataclass
class PlotConfig:
    """Options of a picture of curves."""

    runs: list[str] = field(default_factory=list)
    """What is drawn: run folders, sweep folders, folders of runs; words before options."""
    metric: str = "return_mean"
    """Column of metrics.csv; several with commas between them are drawn below one another."""
    x: XAxis = XAxis.decisions
    """The axis: agent decisions, or seconds of collecting and learning."""
    out: str = "curves.png"
    """Picture to write, NAME.png or NAME.svg."""

    def __post_init__(self) -> None:
        _check_shown(self.runs, "mappo-plot")
        _not_empty(metric=self.metric, out=self.out)


@dataclass
class ReportConfig:
    """Options of a page about runs."""

    runs: list[str] = field(default_factory=list)
    """What the page is about: run folders, sweep folders, folders of runs; words before options."""
    out: Optional[str] = None
    """Page to write; null: report.html in the folder."""

    def __post_init__(self) -> None:
        _check_shown(self.runs, "mappo-report")
        _not_empty(out=self.out)


def _check_shown(runs: list[str], command: str) -> None:
    if not runs:
        raise ConfigError(f"no run is named: name run folders before the options, {command} RUN")
    if "" in runs:
        raise ConfigError("a run is empty: give run folders, or folders of runs")


def _not_empty(**options: Optional[str]) -> None:
    for name, value in options.items():
        if value == "":
            raise ConfigError(f"{name}= is empty: give it a value, or leave it out")


def _check_widths(option: str, widths: list[int]) -> None:
    if not widths or any(width < 1 for width in widths):
        raise ConfigError(
            f"{option}={list(widths)} must be a list of at least one width, each >= 1, "
            f"for example {option}=[128,128]"
        )


def _rule(option: str, value: float | None, holds: bool, rule: str) -> None:
    if value is not None and not (math.isfinite(value) and holds):
        if not math.isfinite(value) and "finite" not in rule:
            rule += ", and finite"
        raise ConfigError(f"{option}={value} is out of range: {option} {rule}")


def _at_least(option: str, value: float | None, low: float) -> None:
    _rule(option, value, value is None or value >= low, f"must be >= {low}")


def _above(option: str, value: float | None, low: float) -> None:
    _rule(option, value, value is None or value > low, f"must be > {low}")


def _within(option: str, value: float, low: float, high: float) -> None:
    _rule(option, value, low <= value <= high, f"must be from {low} to {high}")


def _between(option: str, value: float, low: float, high: float) -> None:
    _rule(option, value, low < value < high, f"must be between {low} and {high}, exclusive")
