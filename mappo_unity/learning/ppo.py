"""PPO for one policy name: a batch ``[T, ..., A]`` in, better networks and metrics out.

`PolicyLearner.learn` reads top to bottom: values, advantages, rows, minibatches, statistics.
"""

from __future__ import annotations

import copy
import math
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.data.replay_buffers import SamplerWithoutReplacement
from torchrl.modules import ProbabilisticActor

from mappo_unity import keys
from mappo_unity.config.schema import Optimizer, PPOConfig, ValueNormKind
from mappo_unity.learning.actor_critic import project
from mappo_unity.learning.advantage import explained_variance, masked_gae, masked_mean, normalize, scheduled
from mappo_unity.learning.critics import Critic
from mappo_unity.learning.encoders import RunningNorm
from mappo_unity.learning.loss import ACTOR_LEARNS, CRITIC_LEARNS, MaskedClipPPOLoss
from mappo_unity.learning.value_norm import ValueNorm


class PolicyLearner:
    """Everything that learns for one policy name.

    Args:
        actor, critic: see `learning.actor_critic`.
        cfg: the learner's options.
        max_rows: team rows of the largest batch.
        team_size: slots of a row.
    """

    def __init__(
        self,
        actor: ProbabilisticActor,
        critic: TensorDictModule,
        cfg: PPOConfig,
        max_rows: int,
        team_size: int,
    ) -> None:
        self.actor, self.critic, self.cfg = actor, critic, cfg
        self.loss = MaskedClipPPOLoss(actor, critic, cfg)
        self.params = [*actor.parameters(), *critic.parameters()]
        self.optimizer = make_optimizer(self.params, cfg)
        self.value_norm = ValueNorm(cfg.value_norm_beta, cfg.normalize_values is not ValueNormKind.none)

        self.critic_keys = [str(key) for key in critic.in_keys]
        self.value_layers = [m.head for m in critic.modules() if isinstance(m, Critic)]
        inputs = [*(str(key) for key in actor.in_keys), *self.critic_keys]
        self.row_keys = list(dict.fromkeys([*inputs, keys.ACTION, keys.LOG_PROB]))

        self.norms = [m for net in (actor, critic) for m in net.modules() if isinstance(m, RunningNorm)]
        self.updates = self.rollbacks = 0  # rolled back ones are counted in both

        self.buffer = ReplayBuffer(
            storage=LazyTensorStorage(max_rows),
            sampler=SamplerWithoutReplacement(),
            batch_size=minibatch_rows(cfg, max_rows, team_size),
        )

    def learn(self, batch: TensorDictBase, progress: float) -> dict[str, float]:
        """Improve the networks by one batch.

        Args:
            batch: ``[T, ..., A]`` entries of this policy name, as collected.
            progress: share of the run that is over, 0 to 1, for the schedules.

        Returns:
            Metrics.
        """
        settings = self._set_schedules(progress)
        rows, metrics = self._prepare(batch)
        metrics |= self._update(rows) if len(rows) else {}
        self._update_norms(batch)
        return metrics | settings

    def _set_schedules(self, progress: float) -> dict[str, float]:
        cfg = self.cfg
        lr = scheduled(cfg.lr_schedule, cfg.lr, cfg.lr_final, progress)
        clip = scheduled(cfg.clip_schedule, cfg.clip_epsilon, cfg.clip_epsilon_final, progress)
        entropy = scheduled(cfg.entropy_schedule, cfg.entropy_coef, cfg.entropy_coef_final, progress)

        for group in self.optimizer.param_groups:
            group["lr"] = lr
        self.loss.clip_epsilon.fill_(clip)
        self.loss.entropy_coeff.fill_(entropy)

        return {"lr": lr, "clip_epsilon": clip, "entropy_coef": entropy}

    @torch.no_grad()
    def _prepare(self, batch: TensorDictBase) -> tuple[TensorDictBase, dict[str, float]]:
        """Add advantages and targets; return the team rows ``[R, A]`` in which anybody learns."""
        following = batch.get("next")
        acting, truncated = batch.get(keys.ACTING), following.get(keys.TRUNCATED)

        value = self._values(batch)
        estimate = masked_gae(
            self.cfg.reward_weight * following.get(keys.REWARD)
            + self.cfg.group_reward_weight * following.get(keys.GROUP_REWARD),
            value,
            self._end_values(following, truncated),
            self._values(following[-1]),
            has_value(batch),
            has_value(following[-1]),
            following.get(keys.TERMINATED),
            truncated,
            gamma=self.cfg.gamma,
            gae_lambda=self.cfg.gae_lambda,
        )

        learns = estimate.known & acting
        metrics = {
            "explained_variance": float(explained_variance(value, estimate.target, learns)),
            "value_mean": float(masked_mean(value, learns)),
        }

        # `value` was denormalised above, and is normalised below: the statistics move in between
        self._move_value_norm(estimate.target[estimate.known])

        advantage = (
            normalize(estimate.advantage, learns) if self.cfg.normalize_advantages else estimate.advantage
        )

        entries = {key: batch.get(key) for key in self.row_keys}
        entries |= {keys.ADVANTAGE: advantage, keys.VALUE_TARGET: self.value_norm.normalize(estimate.target)}
        entries |= {
            ACTOR_LEARNS: learns,
            CRITIC_LEARNS: estimate.known,
            keys.VALUE: self.value_norm.normalize(value),
        }

        # rows without an action to learn from would only dilute the minibatches
        rows = TensorDict(entries, batch.batch_size).flatten(0, -2)
        used = learns.flatten(0, -3).any(-2).squeeze(-1)
        return (rows if bool(used.all()) else rows[used]), metrics

    @torch.no_grad()
    def _values(self, entries: TensorDictBase) -> Tensor:
        """The critic's values in the reward's scale."""
        out = self.critic(entries.select(*self.critic_keys))
        return self.value_norm.denormalize(out.get(keys.VALUE))

    @torch.no_grad()
    def _move_value_norm(self, returns: Tensor) -> None:
        """Take returns into the statistics; with PopArt the critic's values stay what they were.

        PopArt (van Hasselt et al., arXiv 1602.07714, eq. 7): w' = w std / std',
        b' = (std b + mean - mean') / std'.
        """
        mean, std = self.value_norm.statistics()
        self.value_norm.update(returns)
        if self.cfg.normalize_values is not ValueNormKind.popart:
            return

        new_mean, new_std = self.value_norm.statistics()
        for layer in self.value_layers:
            layer.weight.mul_(std / new_std)
            layer.bias.mul_(std).add_(mean - new_mean).div_(new_std)

    def _end_values(self, following: TensorDictBase, truncated: Tensor) -> Tensor:
        """Values of terminal observations of cut episodes, 0 elsewhere."""
        out = torch.zeros(truncated.shape, device=truncated.device)
        where = truncated.flatten(0, -3).any(-2).squeeze(-1)

        # the critic runs only on rows that need it
        if where.any():
            rows = following.select(*self.critic_keys).flatten(0, -2)[where]
            out.flatten(0, -3)[where] = self._values(rows)

        return out

    def _update(self, rows: TensorDictBase) -> dict[str, float]:
        """Run the epochs; take everything back if a number is not finite or the KL explodes."""
        before = copy.deepcopy(self._trainable_state())

        self.buffer.empty()
        self.buffer.extend(rows)

        sums: dict[str, Tensor] = {}
        steps, kl_epoch, stopped = 0, 0.0, False
        for _ in range(self.cfg.epochs):
            kls = []
            for minibatch in self.buffer:
                terms = self._step(minibatch)
                sums = {k: v + sums.get(k, 0.0) for k, v in terms.items()}
                kls.append(terms["kl"])
                steps += 1

            # one look at the KL an epoch: every look waits for the device
            kl_epoch = float(torch.stack(kls).mean())
            # beyond max_kl the update is taken back below, beyond target_kl it only ends early
            if not math.isfinite(kl_epoch) or kl_epoch > self.cfg.max_kl:
                break
            if self.cfg.target_kl is not None and kl_epoch > self.cfg.target_kl:
                stopped = True
                break

        metrics = {name: float(value) / steps for name, value in sums.items()}
        healthy = all(math.isfinite(v) for v in metrics.values()) and self._weights_finite()

        self.updates += 1
        if not healthy or kl_epoch > self.cfg.max_kl:
            self._load_trainable(before)
            self.rollbacks += 1

        rolled = {"rolled_back": float(not healthy or kl_epoch > self.cfg.max_kl)}
        return (
            metrics
            | rolled
            | {"kl_last": kl_epoch, "kl_stopped": float(stopped), "rollbacks": float(self.rollbacks)}
        )

    def _step(self, minibatch: TensorDictBase) -> dict[str, Tensor]:
        losses = self.loss(minibatch)
        total = losses["loss_objective"] + losses["loss_critic"] + losses["loss_entropy"]

        self.optimizer.zero_grad()
        total.backward()
        grad_norm = nn.utils.clip_grad_norm_(self.params, self.cfg.max_grad_norm, foreach=True)
        self.optimizer.step()
        project(self.actor)

        with torch.no_grad():
            mask, log_ratio = minibatch.get(ACTOR_LEARNS), self.loss.log_ratio
            # k3 of http://joschu.net/blog/kl-approx.html: (r - 1) - log r, never negative
            kl = masked_mean(torch.where(mask, log_ratio.exp() - 1 - log_ratio, 0.0), mask)
            clipped = masked_mean((log_ratio.exp() - 1).abs() > self.loss.clip_epsilon, mask)

        return {
            "policy_loss": losses["loss_objective"].detach(),
            "value_loss": losses["loss_critic"].detach(),
            "entropy": masked_mean(self.loss.entropy.view(mask.shape), mask),
            "kl": kl,
            "clip_fraction": clipped,
            "grad_norm": grad_norm.detach(),
        }

    @torch.no_grad()
    def _update_norms(self, batch: TensorDictBase) -> None:
        """Take the batch's observations into the normalisers, after the update that must not see it."""
        if self.norms:
            rows = batch.get(keys.OBS)[batch.get(keys.ACTING).squeeze(-1)]
            for norm in self.norms:
                norm.update(rows)

    def _weights_finite(self) -> bool:
        return all(bool(torch.isfinite(p).all()) for p in self.params)

    def _trainable_state(self) -> dict[str, Any]:
        return {
            "actor": self.actor.state_dict(),
            "critic": self.critic.state_dict(),
            "optimizer": self.optimizer.state_dict(),
        }

    def _load_trainable(self, state: dict[str, Any]) -> None:
        self.actor.load_state_dict(state["actor"])
        self.critic.load_state_dict(state["critic"])
        self.optimizer.load_state_dict(state["optimizer"])

    def state_dict(self) -> dict[str, Any]:
        """Return everything that resuming needs."""
        return self._trainable_state() | {
            "value_norm": self.value_norm.state_dict(),
            "updates": self.updates,
            "rollbacks": self.rollbacks,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Resume from what `state_dict` returned."""
        self._load_trainable(state)
        self.value_norm.load_state_dict(state["value_norm"])
        self.rollbacks = int(state["rollbacks"])
        self.updates = int(state.get("updates", self.rollbacks))  # written since 0.2


def minibatch_rows(cfg: PPOConfig, rows: int, team_size: int) -> int:
    """Return the team rows of a minibatch."""
    if cfg.num_minibatches is not None:
        # rounded up: rounded down it would give one minibatch too many
        return -(-rows // cfg.num_minibatches)
    return min(rows, max(1, cfg.minibatch_size // team_size))


def has_value(entries: TensorDictBase) -> Tensor:
    """Return which slots a value counts for: those that act, and departed ones while a team mate acts."""
    acting = entries.get(keys.ACTING)
    return acting | (entries.get(keys.DEPARTED) & acting.any(-2, keepdim=True))


def make_optimizer(params: list[nn.Parameter], cfg: PPOConfig) -> torch.optim.Optimizer:
    """Build the optimizer; its fused form makes one pass over all parameters."""
    kind = torch.optim.AdamW if cfg.optimizer is Optimizer.adamw else torch.optim.Adam
    return kind(params, lr=cfg.lr, weight_decay=cfg.weight_decay, eps=1e-5, fused=True)
