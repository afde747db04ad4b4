"""The loss of PPO over slots of which not all act: TorchRL's ClipPPOLoss with masks and ML-Agents' variants.

ClipPPOLoss sets it up; `forward` is our own, since masks, ratios of an action's components, baselines and
memories need another one, and TorchRL's wrappers cost more than small networks do.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torch.nn.functional import huber_loss
from torchrl.objectives import ClipPPOLoss

from mappo_unity import keys
from mappo_unity.config.schema import EntropyKind, ObjectiveKind, PPOConfig, RatioKind, ValueLoss
from mappo_unity.learning.advantage import last_mean, scheduled
from mappo_unity.learning.networks.actor_critic import UnityActor
from mappo_unity.learning.networks.distributions import ActionDistribution
from mappo_unity.learning.networks.poca import PocaCritic
from mappo_unity.learning.networks.recurrent import RecurrentCritic
from mappo_unity.learning.reduction import ALONE, Reduction
from mappo_unity.learning.torch_settings import compiled
from mappo_unity.learning.value_norm import ValueNorm

ACTOR_LEARNS = "actor_learns"  # bool [rows, A, 1]: it acted, and the outcome is known; absent: all
CRITIC_LEARNS = "critic_learns"  # bool [rows, A, 1]: the same, or it departed while a team mate acted
PROXIMAL = "proximal_log_prob"  # float32 [rows, A, n]: under the policy that the update began with
BASELINE = "baseline"  # float32 [rows, A, V]: what a POCA critic said before the update, normalised
TEAM = "team"  # with recurrent memory: the critic's inputs of the whole team, [B, L, A, *]
MEMBER = "member"  # with recurrent memory: int64 [B], the slot of the team whose decisions the sequence holds
MOST_WEIGHT = 100.0  # an importance weight at most (imp_samp_max in Hilton et al.'s code, openai/ppo-ewma)
BASELINE_WEIGHT = 0.5  # of the baseline's loss beside the value's (ML-Agents, poca/optimizer_torch.py)


class MaskedClipPPOLoss(ClipPPOLoss):
    """ClipPPOLoss over the slots that acted.

    With ``ppo.objective=decoupled`` (Hilton et al., arXiv 2110.00641, section 3) the policy that the update
    began with stands between the one that learns and the one that collected the batch:

        r = pi / pi_proximal,  w = min(pi_proximal / pi_behavior, MOST_WEIGHT)
        objective = mean of w * min(r A, clip(r, 1 - epsilon, 1 + epsilon) A)

    Where both are the same policy, w is 1 and this is PPO's objective.

    Args:
        actor, critic: see `learning.networks.actor_critic`.
        cfg: the learner's options.

    Attributes: `reduction`, of several learners; losses are then this one's part; `log_ratio` and `ratio`
    ``[..., n]`` and `entropy` ``[..., 1]`` of the last call, without gradients; n is 1, or with
    ``ppo.ratio=component`` the components of an action.
    """

    def __init__(self, actor: UnityActor, critic: TensorDictModule, cfg: PPOConfig) -> None:
        super().__init__(
            actor,
            critic,
            clip_epsilon=cfg.clip_epsilon,
            entropy_coeff=cfg.entropy_coef,
            critic_coeff=cfg.value_coef,
            normalize_advantage=False,
            functional=False,
        )
        self.cfg = cfg
        self.reduction: Reduction = ALONE
        self.set_keys(value=keys.VALUE, sample_log_prob=keys.LOG_PROB, action=keys.ACTION)
        self._actor, self._critic = actor, critic.module
        self._policy: Callable[..., Tensor] = compiled(actor.module[0].module.forward, cfg.compile)
        self._judge: Callable[..., Any] = compiled(judging_method(critic.module), cfg.compile)
        self.critic_keys = [str(key) for key in critic.in_keys]
        self.log_ratio = self.ratio = self.entropy = torch.zeros(())

    def begin(self, progress: float) -> dict[str, float]:
        """Set clipping and the entropy's weight after a share of the run, 0 to 1; return them."""
        cfg = self.cfg
        clip = scheduled(cfg.clip_schedule, cfg.clip_epsilon, cfg.clip_epsilon_final, progress)
        entropy = scheduled(cfg.entropy_schedule, cfg.entropy_coef, cfg.entropy_coef_final, progress)
        self.clip_epsilon.fill_(clip)
        self.entropy_coeff.fill_(entropy)
        return {"clip_epsilon": clip, "entropy_coef": entropy}

    def forward(self, rows: TensorDictBase) -> dict[str, Tensor]:
        """Return ``loss_objective``, ``loss_critic`` and ``loss_entropy``, scalars to be added.

        Args:
            rows: team rows ``[R, A]``; with a recurrent memory, sequences ``[B, L]`` of single agents.
        """
        clip, mask = self.clip_epsilon.item(), rows.get(ACTOR_LEARNS, None)
        dist = self._distribution(rows)
        ratio = self._ratio(dist, rows, mask)

        advantage = rows.get(keys.ADVANTAGE)
        gain = torch.min(ratio * advantage, ratio.clamp(1 - clip, 1 + clip) * advantage)
        if self.cfg.objective is ObjectiveKind.decoupled:
            gain = gain * self._weight(rows, mask)
        entropy = dist.entropy(mean=self.cfg.entropy is EntropyKind.mean).unsqueeze(-1)
        self.entropy = entropy.detach()

        part = self.reduction.part
        return {
            "loss_objective": -part(last_mean(gain), mask),
            "loss_critic": self.cfg.value_coef * self._critic_loss(rows, clip),
            "loss_entropy": -self.entropy_coeff.item() * part(entropy, mask),
        }

    @torch.no_grad()
    def compare(self, rows: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Return `log_ratio` and `ratio` of what the policy now makes of these rows, without the rest."""
        self._ratio(self._distribution(rows), rows, rows.get(ACTOR_LEARNS, None))
        return self.log_ratio, self.ratio

    @torch.no_grad()
    def log_probs(self, rows: TensorDictBase) -> Tensor:
        """Return the log-probabilities ``[..., n]`` that the policy now gives these rows' actions."""
        return self._log_probs(self._distribution(rows), rows)

    def _distribution(self, rows: TensorDictBase) -> ActionDistribution:
        obs = [rows.get(key) for key in self._actor.obs_keys]
        if self._actor.is_recurrent:
            params = self._actor.module[0].module.unroll(*obs, rows.get(keys.MEMORY))
        elif self._actor.has_memory:  # of traces: each row has those before it
            params, _ = self._policy(*obs, rows.get(keys.MEMORY))
        else:
            params = self._policy(*obs)
        mask = rows.get(keys.MASK) if self._actor.layout.branches else None
        return ActionDistribution(params, self._actor.layout, mask)

    def _ratio(self, dist: ActionDistribution, rows: TensorDictBase, mask: Tensor | None) -> Tensor:
        """Return ratios ``[..., n]``: of the whole action, or of its components."""
        is_decoupled = self.cfg.objective is ObjectiveKind.decoupled
        old = rows.get(PROXIMAL) if is_decoupled else self._behavior(rows)
        log_ratio = _where(mask, self._log_probs(dist, rows) - old)
        ratio = log_ratio.exp()
        self.log_ratio, self.ratio = log_ratio.detach(), ratio.detach()
        return ratio

    def _weight(self, rows: TensorDictBase, mask: Tensor | None) -> Tensor:
        """Return the importance weights ``[..., n]`` of the proximal policy, bounded."""
        return _where(mask, rows.get(PROXIMAL) - self._behavior(rows)).exp().clamp_max(MOST_WEIGHT)

    def _log_probs(self, dist: ActionDistribution, rows: TensorDictBase) -> Tensor:
        if self.cfg.ratio is RatioKind.component:
            return dist.component_log_probs(rows.get(keys.ACTION))
        return dist.log_prob(rows.get(keys.ACTION)).unsqueeze(-1)

    def _behavior(self, rows: TensorDictBase) -> Tensor:
        """Return the log-probabilities ``[..., n]`` with which the actions were chosen."""
        if self.cfg.ratio is RatioKind.component:
            return rows.get(keys.LOG_PROBS)
        return rows.get(keys.LOG_PROB).unsqueeze(-1)

    def _critic_loss(self, rows: TensorDictBase, clip: float) -> Tensor:
        mask, target = rows.get(CRITIC_LEARNS, None), rows.get(keys.VALUE_TARGET)
        value, baseline = self._values(rows)

        loss = self._distance(value, target, rows.get(keys.VALUE) if self.cfg.clip_value else None, clip)
        loss = self.reduction.part(loss, mask)
        if baseline is None:
            return loss

        # ML-Agents clips the baseline's move, and not the value's
        beside = self._distance(baseline, target, rows.get(BASELINE), clip)
        return loss + BASELINE_WEIGHT * self.reduction.part(beside, rows.get(ACTOR_LEARNS, None))

    def _values(self, rows: TensorDictBase) -> tuple[Tensor, Tensor | None]:
        """Return values, and baselines where the critic has them."""
        critic = self._critic
        if isinstance(critic, RecurrentCritic):
            inputs = [rows.get((TEAM, key)) for key in self.critic_keys]
            action = rows.get((TEAM, keys.ACTION)) if critic.has_baseline else None
            return critic.unroll(inputs, action, rows.get(MEMBER), rows)

        inputs = [rows.get(key) for key in self.critic_keys]
        if not isinstance(critic, PocaCritic):
            return self._judge(*inputs), None
        value, baseline = self._judge(*inputs, rows.get(keys.ACTION))
        return value, baseline

    def _distance(self, value: Tensor, target: Tensor, old: Tensor | None, clip: float) -> Tensor:
        """Return distances ``[..., 1]`` of values ``[..., V]``: the mean over reward streams (ML-Agents)."""
        loss = self._unclipped(value, target)
        if old is not None:
            loss = torch.max(loss, self._unclipped(old + (value - old).clamp(-clip, clip), target))
        return last_mean(loss)

    def _unclipped(self, value: Tensor, target: Tensor) -> Tensor:
        if self.cfg.value_loss is ValueLoss.huber:
            return huber_loss(value, target, reduction="none", delta=self.cfg.huber_delta)
        return (value - target) ** 2


def judging_method(critic: nn.Module) -> Callable[..., Any]:
    """Return what gives a critic's values for rows, and a POCA critic's baselines beside them."""
    return critic.value_and_baseline if isinstance(critic, PocaCritic) else critic.forward


def _where(mask: Tensor | None, log_ratio: Tensor) -> Tensor:
    """Return the log ratios, 0 in rows that do not count: what stands there may be anything."""
    return log_ratio if mask is None else torch.where(mask, log_ratio, 0.0)


@torch.no_grad()
def move_with_minibatch(norm: ValueNorm, rows: TensorDictBase) -> None:
    """Take a minibatch's targets into the statistics and normalise them by these, in place."""
    targets, learns = rows.get(keys.VALUE_TARGET), rows.get(CRITIC_LEARNS, None)
    norm.update(targets.flatten(0, -2) if learns is None else targets[learns.squeeze(-1)])
    rows.set(keys.VALUE_TARGET, norm.normalize(targets))
