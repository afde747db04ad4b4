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
from torch import Tensor
from torchrl.data import ReplayBuffer

from mappo_unity import keys
from mappo_unity.config.schema import ObsNormUpdate, PPOConfig, RatioKind, ValueNormKind, ValueNormUpdate
from mappo_unity.learning.advantage import (
    Advantage,
    estimate,
    explained_variance,
    make_view,
    masked_mean,
    normalize,
    scheduled,
)
from mappo_unity.learning.carried import VALUED, CarriedRounds, has_value
from mappo_unity.learning.loss import ACTOR_LEARNS, BASELINE, CRITIC_LEARNS, MaskedClipPPOLoss
from mappo_unity.learning.minibatches import make_buffer
from mappo_unity.learning.networks.actor_critic import Actor, UnityActor, value_layers
from mappo_unity.learning.networks.encoders import running_norms, update_norms
from mappo_unity.learning.networks.poca import PocaCritic
from mappo_unity.learning.optimizer import clip_gradients, in_two_groups, make_optimizer
from mappo_unity.learning.rows import make_rows
from mappo_unity.learning.value_norm import ValueNorm, move_statistics
from mappo_unity.learning.value_reader import ValueReader, Values


class PolicyLearner:
    """Everything that learns for one policy name.

    Args:
        actor, critic: see `learning.networks.actor_critic`; both have a memory, or neither.
        cfg: the learner's options.
    """

    def __init__(self, actor: UnityActor, critic: TensorDictModule, cfg: PPOConfig) -> None:
        self.actor, self.critic, self.cfg = actor, critic, cfg
        actor.keeps_components = cfg.ratio is RatioKind.component
        self.loss = MaskedClipPPOLoss(actor, critic, cfg)
        self.optimizer = make_optimizer(actor, critic, cfg)
        self.params = [*actor.parameters(), *critic.parameters()]
        self.value_norm = ValueNorm(cfg.value_norm_beta, cfg.normalize_values is not ValueNormKind.none)
        self.reader = ValueReader(critic, self.value_norm)

        inputs = [str(key) for net in (actor, critic) for key in net.in_keys]
        written = [keys.ACTION, keys.LOG_PROB] + [keys.LOG_PROBS] * actor.keeps_components
        self.row_keys = list(dict.fromkeys([*inputs, *written]))
        self.has_baseline = any(isinstance(m, PocaCritic) for m in critic.modules())
        self.carried = CarriedRounds(self.row_keys + [keys.FIRST] * actor.has_memory, self.has_baseline)
        self.rows = make_rows(self.row_keys, critic, cfg)

        self.value_layers = value_layers(critic)  # which PopArt rescales
        self.bounded = [m for m in actor.modules() if isinstance(m, Actor)]
        actor_norms, critic_norms = running_norms(actor), running_norms(critic)
        self.norms = [*actor_norms, *critic_norms]
        if cfg.obs_norm_update is ObsNormUpdate.round:
            actor.moving_norms = actor_norms
        self.updates = self.rollbacks = 0  # rolled back ones are counted in both

    def learn(self, batch: TensorDictBase, progress: float) -> dict[str, float]:
        """Improve the networks by one batch.

        Args:
            batch: ``[T, ..., A]`` entries of this policy name, as collected.
            progress: share of the run that is over, 0 to 1, for the schedules.

        Returns:
            Metrics.
        """
        settings = self._set_schedules(progress)
        for norm in self.norms if self.actor.moving_norms else ():
            norm.load_state_dict(self.actor.moving_norms[0].state_dict())  # the critic's follow

        buffer, metrics = self.prepare(batch)
        metrics |= self.update(buffer) if buffer is not None else {}
        if not self.actor.moving_norms:
            update_norms(self.norms, batch)  # after the update, which must not see it
        return metrics | settings

    def _set_schedules(self, progress: float) -> dict[str, float]:
        cfg = self.cfg
        lr = scheduled(cfg.lr_schedule, cfg.lr, cfg.lr_final, progress)
        clip = scheduled(cfg.clip_schedule, cfg.clip_epsilon, cfg.clip_epsilon_final, progress)
        entropy = scheduled(cfg.entropy_schedule, cfg.entropy_coef, cfg.entropy_coef_final, progress)

        # the actor's parameters, then the critic's
        start = cfg.lr if cfg.critic_lr is None else cfg.critic_lr
        critic_lr = scheduled(cfg.lr_schedule, start, cfg.lr_final, progress)
        for group, rate in zip(self.optimizer.param_groups, (lr, critic_lr)):
            group["lr"] = rate
        self.loss.clip_epsilon.fill_(clip)
        self.loss.entropy_coeff.fill_(entropy)

        return {"lr": lr, "clip_epsilon": clip, "entropy_coef": entropy}

    @torch.no_grad()
    def prepare(self, batch: TensorDictBase) -> tuple[ReplayBuffer | None, dict[str, float]]:
        """Add advantages and targets; return a buffer of the rows that are learnt, None if there are none."""
        following = batch.get("next")
        rounds = self.carried.join(batch)
        values = self.reader.read(rounds, following)

        ended = rounds.get(keys.TERMINATED) | rounds.get(keys.TRUNCATED)
        view = make_view(rounds.get(VALUED), has_value(following[-1]), ended)
        gae = estimate(
            view,
            self._rewards(rounds),
            values.value,
            values.end,
            values.final,
            rounds.get(keys.TRUNCATED),
            gamma=self.cfg.gamma,
            gae_lambda=self.cfg.gae_lambda,
            horizon=self.cfg.time_horizon,
        )
        self.carried.keep(rounds, view)
        self.reader.keep(values, rounds.get(VALUED) & ~gae.known)

        learns = gae.known & rounds.get(keys.ACTING)
        metrics = {
            "explained_variance": float(explained_variance(values.value, gae.target, learns)),
            "value_mean": float(masked_mean(values.value, learns)),
        }
        self._enter(rounds, values, gae, learns)
        rows, decisions = self.rows.of(rounds, view)
        return (make_buffer(rows, decisions, self.cfg) if len(rows) else None), metrics

    def _rewards(self, rounds: TensorDict) -> Tensor:
        """Return the weighted rewards of each round."""
        own = self.cfg.reward_weight * rounds.get(keys.REWARD)
        return own + self.cfg.group_reward_weight * rounds.get(keys.GROUP_REWARD)

    def _enter(self, rounds: TensorDict, values: Values, gae: Advantage, learns: Tensor) -> None:
        """Set the entries that the loss reads beside inputs and actions."""
        # values were denormalised, and are normalised below: the statistics move in between
        by_minibatch = self.cfg.value_norm_update is ValueNormUpdate.minibatch
        if not by_minibatch:
            move_statistics(
                self.value_norm,
                gae.target[gae.known],
                self.value_layers if self.cfg.normalize_values is ValueNormKind.popart else (),
            )

        advantage = gae.advantage
        if values.baseline is not None:
            advantage = torch.where(gae.known, gae.target - values.baseline, 0.0)
        if self.cfg.normalize_advantages:
            advantage = normalize(advantage, learns)

        # where the statistics move with each minibatch, it normalises these itself
        scaled = (lambda x: x) if by_minibatch else self.value_norm.normalize
        rounds.set(keys.ADVANTAGE, advantage)
        rounds.set(keys.VALUE_TARGET, scaled(gae.target))
        rounds.set(keys.VALUE, scaled(values.value))
        if values.baseline is not None:
            rounds.set(BASELINE, scaled(values.baseline))
        for name, state in values.states.items():
            rounds.set(name, state)
        rounds.set(ACTOR_LEARNS, learns)
        rounds.set(CRITIC_LEARNS, gae.known)

    def update(self, buffer: ReplayBuffer) -> dict[str, float]:
        """Run the epochs; take everything back if a number is not finite or the KL explodes."""
        before = copy.deepcopy(self._trainable_state())

        sums: dict[str, Tensor] = {}
        steps, kl_epoch, stopped = 0, 0.0, False
        for _ in range(self.cfg.epochs):
            kls = []
            for minibatch in buffer:
                minibatch = self.rows.take(minibatch)
                terms = self.step(minibatch)
                sums = {k: v + sums.get(k, 0.0) for k, v in terms.items()}
                kls.append(terms["kl"])
                steps += 1

            # one look at the KL an epoch: every look waits for the device
            kl_epoch = float(torch.stack(kls).mean())
            if not math.isfinite(kl_epoch) or kl_epoch > self.cfg.max_kl:
                break
            if self.cfg.target_kl is not None and kl_epoch > self.cfg.target_kl:
                stopped = True
                break

        # each step's KL is that before it: what the last one did is seen only now
        kl_after = float(self._kl_after(minibatch))
        metrics = {name: float(value) / steps for name, value in sums.items()}
        healthy = all(map(math.isfinite, (*metrics.values(), kl_after))) and self._weights_finite()

        self.updates += 1
        rolled_back = not healthy or max(kl_epoch, kl_after) > self.cfg.max_kl
        if rolled_back:
            self._load_trainable(before)
            self.rollbacks += 1

        return metrics | {
            "rolled_back": float(rolled_back),
            "kl_last": max(kl_epoch, kl_after) if healthy else kl_after,
            "kl_stopped": float(stopped),
            "rollbacks": float(self.rollbacks),
        }

    def step(self, minibatch: TensorDictBase) -> dict[str, Tensor]:
        """Take one step of the optimizer; return its terms, as they were before it."""
        if self.cfg.value_norm_update is ValueNormUpdate.minibatch:
            self._normalize_values(minibatch)
        losses = self.loss(minibatch)
        total = losses["loss_objective"] + losses["loss_critic"] + losses["loss_entropy"]

        self.optimizer.zero_grad()
        total.backward()
        grad_norm = clip_gradients(self.optimizer, self.cfg)
        self.optimizer.step()
        for net in self.bounded:
            net.project()

        with torch.no_grad():
            mask, log_ratio = minibatch.get(ACTOR_LEARNS, None), self.loss.log_ratio
            clipped = ((log_ratio.exp() - 1).abs() > self.loss.clip_epsilon.item()).float()
            return {
                "policy_loss": losses["loss_objective"].detach(),
                "value_loss": losses["loss_critic"].detach(),
                "entropy": masked_mean(self.loss.entropy, mask),
                "kl": self._kl(mask),
                "clip_fraction": masked_mean(clipped.mean(-1, keepdim=True), mask),
                "grad_norm": grad_norm.detach(),
            }

    def _kl(self, mask: Tensor | None) -> Tensor:
        """Return the approximate KL of the last call of the loss."""
        log_ratio = self.loss.log_ratio.sum(-1, keepdim=True)
        # k3 of http://joschu.net/blog/kl-approx.html: (r - 1) - log r, never negative
        return masked_mean(log_ratio.exp() - 1 - log_ratio, mask)

    @torch.no_grad()
    def _kl_after(self, minibatch: TensorDictBase) -> Tensor:
        """Return the approximate KL on the last minibatch, now that its step is taken."""
        self.loss.compare(minibatch)
        return self._kl(minibatch.get(ACTOR_LEARNS, None))

    @torch.no_grad()
    def _normalize_values(self, minibatch: TensorDictBase) -> None:
        """Take a minibatch's targets into the statistics and normalise its values by them."""
        targets, learns = minibatch.get(keys.VALUE_TARGET), minibatch.get(CRITIC_LEARNS, None)
        self.value_norm.update(targets if learns is None else targets[learns])
        for key in (keys.VALUE_TARGET, keys.VALUE, BASELINE):
            if key in minibatch.keys():
                minibatch.set(key, self.value_norm.normalize(minibatch.get(key)))

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
        self.optimizer.load_state_dict(in_two_groups(state["optimizer"], len(list(self.actor.parameters()))))

    def state_dict(self) -> dict[str, Any]:
        """Return everything that resuming needs."""
        state = self._trainable_state()
        if self.actor.moving_norms:  # on, while what is returned here has not been written yet
            state["actor"] = {name: value.clone() for name, value in state["actor"].items()}
        return state | {
            "value_norm": self.value_norm.state_dict(),
            "carried": self.carried.state_dict(),
            "critic_states": self.reader.state_dict(),
            "updates": self.updates,
            "rollbacks": self.rollbacks,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Resume from what `state_dict` returned."""
        self._load_trainable(state)
        self.value_norm.load_state_dict(state["value_norm"])
        self.carried.load_state_dict(state.get("carried"))
        self.reader.load_state_dict(state.get("critic_states", {}))
        self.rollbacks = int(state["rollbacks"])
        self.updates = int(state.get("updates", self.rollbacks))  # written since 0.2
