"""Options of the learner: `ppo.*`."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Optional

from mappo_unity.config.schema.checks import above, at_least, between, rule, within
from mappo_unity.errors import ConfigError


class Optimizer(Enum):
    """Optimizer of the networks."""

    adam = "adam"
    adamw = "adamw"


class Schedule(Enum):
    """How a quantity moves from its start to its end over `max_steps`."""

    constant = "constant"
    linear = "linear"
    cosine = "cosine"


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


class ValueNormKind(Enum):
    """How the critic's targets are normalised."""

    none = "none"
    running = "running"
    popart = "popart"


class ValueLoss(Enum):
    """Distance between the critic's output and its target."""

    huber = "huber"
    mse = "mse"


@dataclass
class PPOConfig:
    """The learner."""

    lr: float = 3e-4
    """Learning rate at the start."""
    lr_schedule: Schedule = Schedule.linear
    """How the learning rate falls to ppo.lr_final over max_steps."""
    lr_final: float = 0.0
    """Learning rate at the end of its schedule."""
    lr_target_kl: Optional[float] = None
    """Steer the learning rates so that an update moves the policy by about this approximate KL: after one
    that moved it twice as far they fall by a third, after one that moved it half as far they rise by a half,
    to between 0.01 and 10 times what their schedule says; null: the schedule alone."""
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
    """Discount of a decision at the start."""
    gamma_schedule: Schedule = Schedule.constant
    """How the discount moves to ppo.gamma_final over max_steps; that of rewards.extrinsic.gamma stays."""
    gamma_final: float = 0.995
    """Discount at the end of its schedule."""
    gamma_from: float = 0.0
    """Share of max_steps after which the discount begins to move."""
    gamma_until: float = 1.0
    """Share after which it is ppo.gamma_final; the same as ppo.gamma_from: it moves at once."""
    gae_lambda: float = 0.95
    """Lambda of generalised advantage estimation."""
    advantage: AdvantageKind = AdvantageKind.gae
    """How advantages are estimated: as if the policy had collected the batch itself (gae), or corrected for
    what an older one did (vtrace), see collect.overlap."""
    recompute_advantages: bool = False
    """Estimate advantages and value targets anew before each further epoch, by the critic as it then is; what
    the policy is compared with stays. Lets more epochs pay."""
    shuffle_members: bool = False
    """Show the critic the members of a team in another order with every minibatch: for teams of equals, whose
    order says nothing. Keeps a central critic from learning a batch by heart; needs
    model.share_parameters=true."""
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
    """Entropy weight at the end of its schedule; below 0 it takes randomness away."""
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
        above("ppo.lr", self.lr, 0)
        above("ppo.critic_lr", self.critic_lr, 0)
        at_least("ppo.sequence_length", self.sequence_length, 1)
        at_least("ppo.lr_final", self.lr_final, 0)
        above("ppo.optimizer_eps", self.optimizer_eps, 0)
        at_least("ppo.weight_decay", self.weight_decay, 0)
        within("ppo.gamma", self.gamma, 0, 1)
        within("ppo.gamma_final", self.gamma_final, 0, 1)
        within("ppo.gamma_from", self.gamma_from, 0, 1)
        until, begins = self.gamma_until, self.gamma_from
        rule("ppo.gamma_until", until, begins <= until <= 1, f"must be from ppo.gamma_from={begins} to 1")
        within("ppo.gae_lambda", self.gae_lambda, 0, 1)
        at_least("ppo.time_horizon", self.time_horizon, 1)
        between("ppo.clip_epsilon", self.clip_epsilon, 0, 1)
        between("ppo.clip_epsilon_final", self.clip_epsilon_final, 0, 1)

        at_least("ppo.critic_warmup_steps", self.critic_warmup_steps, 0)
        at_least("ppo.epochs", self.epochs, 1)
        at_least("ppo.minibatch_size", self.minibatch_size, 1)
        at_least("ppo.num_minibatches", self.num_minibatches, 1)

        at_least("ppo.entropy_coef", self.entropy_coef, 0)
        at_least("ppo.entropy_coef_final", self.entropy_coef_final, -1)
        at_least("ppo.value_coef", self.value_coef, 0)
        between("ppo.value_norm_beta", self.value_norm_beta, 0, 1)
        above("ppo.huber_delta", self.huber_delta, 0)

        above("ppo.max_grad_norm", self.max_grad_norm, 0)
        above("ppo.lr_target_kl", self.lr_target_kl, 0)
        above("ppo.target_kl", self.target_kl, 0)
        above("ppo.max_kl", self.max_kl, 0)
        if (
            self.value_norm_update is ValueNormUpdate.minibatch
            and self.normalize_values is ValueNormKind.popart
        ):
            raise ConfigError(
                "ppo.value_norm_update=minibatch does not go with ppo.normalize_values=popart, which "
                "rescales the critic once for each batch; give ppo.normalize_values=running"
            )
