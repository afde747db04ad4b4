"""What the loss reads of a batch beside inputs and actions: advantages and the critic's targets."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from mappo_unity import keys
from mappo_unity.config.schema import PPOConfig, ValueNormKind, ValueNormUpdate
from mappo_unity.learning.advantage import Advantage, normalize
from mappo_unity.learning.decisions import DecisionView
from mappo_unity.learning.loss import ACTOR_LEARNS, BASELINE, CRITIC_LEARNS
from mappo_unity.learning.reduction import ALONE, Reduction
from mappo_unity.learning.value_norm import ValueNorm, move_statistics
from mappo_unity.learning.value_reader import Values


def enter_masks(rounds: TensorDict, view: DecisionView) -> None:
    """Set who learns from which row: critics from values whose outcome is known, actors from decisions."""
    acting = rounds.get(keys.ACTING)
    known = torch.from_numpy(view.known).view(acting.shape).to(acting.device)
    rounds.set(ACTOR_LEARNS, known & acting)
    rounds.set(CRITIC_LEARNS, known)


def enter_targets(
    rounds: TensorDict,
    values: Values,
    gae: Advantage,
    norm: ValueNorm,
    layers: Sequence[nn.Linear],
    cfg: PPOConfig,
    reduction: Reduction = ALONE,
) -> None:
    """Set the entries; the statistics of returns move on the way.

    Args:
        rounds: ``[R, ..., A]`` with `ACTOR_LEARNS`.
        values: of the rounds, in the rewards' scale.
        gae: their advantages and targets, in the same scale.
        norm: the statistics of returns.
        layers: what PopArt rescales.
        cfg: the learner's options.
        reduction: of several learners.
    """
    # Clipping is around what the critic said: PopArt rescales that with the statistics, nothing else does.
    by_minibatch = cfg.value_norm_update is ValueNormUpdate.minibatch
    rescaled = layers if cfg.normalize_values is ValueNormKind.popart else ()
    said = _outputs(values, norm)
    if not by_minibatch:
        move_statistics(norm, gae.target[gae.known.squeeze(-1)], rescaled)
    if rescaled:
        said = _outputs(values, norm)

    advantage = gae.advantage
    if values.baseline is not None:
        advantage = torch.where(gae.known, gae.advantage + values.value - values.baseline, 0.0)
    if advantage.shape[-1] > 1:  # of several streams
        advantage = advantage.sum(-1, keepdim=True)
    if cfg.normalize_advantages:
        advantage = normalize(advantage, rounds.get(ACTOR_LEARNS), reduction=reduction)

    # where the statistics move with each minibatch, it normalises its targets itself
    rounds.set(keys.ADVANTAGE, advantage)
    rounds.set(keys.VALUE_TARGET, gae.target if by_minibatch else norm.normalize(gae.target))
    for key, output in said.items():
        rounds.set(key, output)


def _outputs(values: Values, norm: ValueNorm) -> dict[str, Tensor]:
    """Return what the critic says of values in the rewards' scale, its baselines where it has them."""
    baseline = {} if values.baseline is None else {BASELINE: norm.normalize(values.baseline)}
    return {keys.VALUE: norm.normalize(values.value)} | baseline
