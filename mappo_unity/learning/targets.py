"""What the loss reads of a batch beside inputs and actions: advantages and the critic's targets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.data import ReplayBuffer

from mappo_unity import keys
from mappo_unity.config.schema import AdvantageKind, PPOConfig, ValueNormKind, ValueNormUpdate
from mappo_unity.learning.advantage import Advantage, estimate_streams, normalize
from mappo_unity.learning.decisions import DecisionView
from mappo_unity.learning.loss import ACTOR_LEARNS, BASELINE, CRITIC_LEARNS
from mappo_unity.learning.minibatches import make_buffer
from mappo_unity.learning.proximal import truncated_ratio
from mappo_unity.learning.reduction import ALONE, Reduction
from mappo_unity.learning.rows import SequenceRows, TeamRows
from mappo_unity.learning.value_norm import ValueNorm, move_statistics
from mappo_unity.learning.value_reader import Values


@dataclass
class PreparedBatch:
    """A batch and what its advantages come from beside values."""

    rounds: TensorDict  # [R, ..., A]: carried rounds, then those of the batch
    following: TensorDictBase  # what was seen after them, see `keys.FINAL`, `keys.CUT_OFF`, `keys.CUT_OFF_AT`
    view: DecisionView  # of the rounds
    rewards: Tensor  # float32 [R, ..., A, V], of all reward streams

    def estimate(self, values: Values, gammas: Sequence[float], cfg: PPOConfig) -> Advantage:
        """Return advantages and targets ``[R, ..., A, V]`` by these values.

        Args:
            values: of the rounds, in the rewards' scale.
            gammas: the discount of each stream.
            cfg: the learner's options.
        """
        return estimate_streams(
            self.view,
            self.rewards,
            values.value,
            values.end,
            values.final,
            self.rounds.get(keys.TRUNCATED),
            gammas=gammas,
            gae_lambda=cfg.gae_lambda,
            horizon=cfg.time_horizon,
            rho_T=truncated_ratio(self.rounds) if cfg.advantage is AdvantageKind.vtrace else None,
        )

    def buffer(
        self, rows: TeamRows | SequenceRows, cfg: PPOConfig, reduction: Reduction
    ) -> ReplayBuffer | None:
        """Return a buffer of the rows that are learnt, None if there are none.

        Args:
            rows: what minibatches are drawn from.
            cfg: the learner's options.
            reduction: of several learners; where one has nothing to learn, all of them wait.
        """
        learnt, decisions = rows.of(self.rounds, self.view)
        if not reduction.least(int(decisions.sum())):
            return None
        return make_buffer(learnt, decisions, cfg, reduction)


def enter_masks(rounds: TensorDict, view: DecisionView) -> None:
    """Set who learns from which row: critics from values whose outcome is known, actors from decisions."""
    acting = rounds.get(keys.ACTING)
    known = torch.from_numpy(view.known).view(acting.shape).to(acting.device)
    rounds.set(ACTOR_LEARNS, known & acting)
    rounds.set(CRITIC_LEARNS, known)


def enter_outputs(
    rounds: TensorDict,
    values: Values,
    gae: Advantage,
    norm: ValueNorm,
    layers: Sequence[nn.Linear],
    cfg: PPOConfig,
) -> None:
    """Set what the critic said before the update; the statistics of returns move on the way.

    Args:
        rounds: ``[R, ..., A]``.
        values: of the rounds, in the rewards' scale.
        gae: their advantages and targets, in the same scale.
        norm: the statistics of returns.
        layers: what PopArt rescales.
        cfg: the learner's options.
    """
    # Clipping is around what the critic said: PopArt rescales that with the statistics, nothing else does.
    rescaled = layers if cfg.normalize_values is ValueNormKind.popart else ()
    said = _outputs(values, norm)
    if not _moves_with_minibatches(cfg):
        move_statistics(norm, gae.target[gae.known.squeeze(-1)], rescaled)
    if rescaled:
        said = _outputs(values, norm)

    for key, output in said.items():
        rounds.set(key, output)


def enter_targets(
    rounds: TensorDict,
    values: Values,
    gae: Advantage,
    norm: ValueNorm,
    cfg: PPOConfig,
    reduction: Reduction = ALONE,
) -> None:
    """Set advantages and the critic's targets.

    Args:
        rounds: ``[R, ..., A]`` with `ACTOR_LEARNS`.
        values, gae, norm, cfg: as in `enter_outputs`.
        reduction: of several learners.
    """
    advantage = gae.advantage
    if values.baseline is not None:
        advantage = torch.where(gae.known, gae.advantage + values.value - values.baseline, 0.0)
    if advantage.shape[-1] > 1:  # of several streams
        advantage = advantage.sum(-1, keepdim=True)
    if cfg.normalize_advantages:
        advantage = normalize(advantage, rounds.get(ACTOR_LEARNS), reduction=reduction)

    # where the statistics move with each minibatch, it normalises its targets itself
    rounds.set(keys.ADVANTAGE, advantage)
    rounds.set(keys.VALUE_TARGET, gae.target if _moves_with_minibatches(cfg) else norm.normalize(gae.target))


def _moves_with_minibatches(cfg: PPOConfig) -> bool:
    return cfg.value_norm_update is ValueNormUpdate.minibatch


def _outputs(values: Values, norm: ValueNorm) -> dict[str, Tensor]:
    """Return what the critic says of values in the rewards' scale, its baselines where it has them."""
    baseline = {} if values.baseline is None else {BASELINE: norm.normalize(values.baseline)}
    return {keys.VALUE: norm.normalize(values.value)} | baseline
