"""PPO for one policy name: a batch ``[T, ..., A]`` in, better networks and metrics out.

`PolicyLearner.learn` reads top to bottom: values, advantages, rows, minibatches, statistics.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.data import ReplayBuffer

from mappo_unity import keys
from mappo_unity.config.schema import (
    ObsNormUpdate,
    PPOConfig,
    RatioKind,
    ValueNormKind,
    ValueNormUpdate,
)
from mappo_unity.learning.advantage import approximate_kl, last_mean, make_view, value_metrics
from mappo_unity.learning.carried import VALUED, CarriedRounds, has_value
from mappo_unity.learning.imitation.cloning import Cloning
from mappo_unity.learning.loss import ACTOR_LEARNS, MaskedClipPPOLoss, move_with_minibatch
from mappo_unity.learning.networks.actor_critic import UnityActor, bounded_actors, value_layers
from mappo_unity.learning.networks.encoders import channels_first, running_norms, update_norms
from mappo_unity.learning.optimizer import (
    CriticWarmup,
    LearningRates,
    clip_gradients,
    cloned,
    in_two_groups,
    load_optimizer,
    make_optimizer,
)
from mappo_unity.learning.proximal import enter_proximal, needs_proximal, stale_kl
from mappo_unity.learning.reduction import ALONE, Reduction, check_reduced
from mappo_unity.learning.rewards.streams import RewardStreams
from mappo_unity.learning.rows import make_rows
from mappo_unity.learning.targets import PreparedBatch, enter_masks, enter_outputs, enter_targets
from mappo_unity.learning.value_norm import ValueNorm, by_stream
from mappo_unity.learning.value_reader import ValueReader


class PolicyLearner:
    """Everything that learns for one policy name.

    Args:
        actor, critic: see `learning.networks.actor_critic`; both are recurrent, or neither.
        cfg: the learner's options.
        rewards: the streams that the critic has values for; None: the environment's rewards alone.
        cloning: of demonstrations, beside PPO or alone; None: there are none.
    """

    def __init__(
        self,
        actor: UnityActor,
        critic: TensorDictModule,
        cfg: PPOConfig,
        rewards: RewardStreams | None = None,
        cloning: Cloning | None = None,
    ) -> None:
        self.actor, self.critic, self.cfg = actor, critic, cfg
        self.reduction: Reduction = ALONE
        self.rewards, self.cloning = rewards or RewardStreams(cfg), cloning
        actor.keeps_components = cfg.ratio is RatioKind.component
        self.loss = MaskedClipPPOLoss(actor, critic, cfg)
        self.optimizer = make_optimizer(actor, critic, cfg)
        self.rates = LearningRates(self.optimizer, cfg)
        self.warmup = CriticWarmup(cfg.critic_warmup_steps, actor)
        self.params = [*actor.parameters(), *critic.parameters()]
        is_normalized = cfg.normalize_values is not ValueNormKind.none
        self.value_norm = ValueNorm(cfg.value_norm_beta, is_normalized, len(self.rewards.names))
        self.reader = ValueReader(critic, self.value_norm)

        inputs = [str(key) for net in (actor, critic) for key in net.in_keys]
        written = [keys.ACTION, keys.LOG_PROB] + [keys.LOG_PROBS] * actor.keeps_components
        self.row_keys = list(dict.fromkeys([*inputs, *written]))
        read = self.row_keys + [keys.FIRST] * actor.is_recurrent
        self.carried = CarriedRounds(read, self.reader.has_baseline, channels_first(critic))
        self.rows = make_rows(self.row_keys, critic, cfg)

        self.prepared: PreparedBatch | None = None  # while it is learnt, with ppo.recompute_advantages
        self.value_layers = value_layers(critic)  # which PopArt rescales
        self.bounded = bounded_actors(actor)
        self.norms = [*running_norms(actor), *running_norms(critic)]
        self.round_norms = running_norms(actor) if cfg.obs_norm_update is ObsNormUpdate.round else []
        self.actor.moving_norms = self.warmup.free(self.round_norms)
        self.updates = self.rollbacks = 0  # rolled back ones are counted in both

    def check_joins(self, size: int) -> None:
        """Raise ConfigError where what is learnt cannot be learnt by `size` learners side by side."""
        check_reduced(size, self.cfg, self.rewards.names, self.cloning is not None)

    def join(self, reduction: Reduction) -> None:
        """Learn beside others from now on, each from a part of a batch; begin with the networks of the first.

        All have the same options, and what else is in their states but the slots' own.
        """
        self.check_joins(reduction.size)
        self.reduction = self.loss.reduction = self.warmup.reduction = self.value_norm.reduction = reduction
        reduction.share([*self.params, *self.actor.buffers(), *self.critic.buffers()])

    def learn(self, batch: TensorDictBase, following: TensorDictBase, progress: float) -> dict[str, float]:
        """Improve the networks by one batch; return metrics.

        Args:
            batch: ``[T, ..., A]`` entries of this policy name, as collected; ``next`` holds rewards and ends.
            following: what was seen after them, see `keys.FINAL`, `keys.CUT_OFF` and `keys.CUT_OFF_AT`.
            progress: share of the run that is over, 0 to 1, for the schedules.
        """
        settings = {"lr": self.rates.begin(progress)} | self.loss.begin(progress)
        settings |= self.rewards.begin(progress) | self.warmup.begin(batch)
        for norm in self.norms if self.round_norms else ():
            norm.load_state_dict(self.round_norms[0].state_dict())  # the critic's follow

        metrics: dict[str, float] = {}
        if self.cloning is None or not self.cloning.cfg.only:
            buffer, metrics = self.prepare(batch, following)
            metrics |= self.update(buffer) if buffer is not None else {}
            metrics |= self.rewards.learn()
            self.prepared = None
            self.rows.forget()
        if self.cloning is not None and (self.cloning.cfg.only or not self.warmup.active):
            metrics |= self.cloning.learn(int(batch.get(keys.ACTING).sum()), settings["lr"], progress)
        if not self.round_norms:
            # after the update, which must not see it
            update_norms(self.warmup.moving(self.norms), batch, self.reduction)
        self.actor.moving_norms = self.warmup.free(self.round_norms)
        return metrics | settings

    @torch.no_grad()
    def prepare(
        self, batch: TensorDictBase, following: TensorDictBase
    ) -> tuple[ReplayBuffer | None, dict[str, float]]:
        """Add advantages and targets; return a buffer of the rows that are learnt, None if there are none."""
        batch, following = self.reader.traced(batch, following)
        rounds = self.carried.join(self.reader.with_actions_under_way(batch))
        values = self.reader.read(rounds, following)

        ended = rounds.get(keys.TERMINATED) | rounds.get(keys.TRUNCATED)
        view = make_view(rounds.get(VALUED), has_value(following.get(keys.FINAL)), ended)
        self.carried.keep(rounds, view)  # without what is entered below
        enter_masks(rounds, view)
        for name, state in values.states.items():
            rounds.set(name, state)

        rewards, metrics = self.rewards.rewards(rounds, following, view)
        if needs_proximal(self.cfg):
            enter_proximal(rounds, view, self.rows, self.loss)
            metrics["stale_kl"] = stale_kl(rounds, self.reduction)
        prepared = PreparedBatch(rounds, following, view, rewards)
        self.prepared = prepared if self.cfg.recompute_advantages else None  # images would fill the memory
        gae = prepared.estimate(values, self.rewards.gammas, self.cfg)
        self.reader.keep(values, rounds.get(VALUED) & ~gae.known)

        learns = rounds.get(ACTOR_LEARNS)
        metrics |= value_metrics(self.rewards.names, values.value, gae.target, learns, self.reduction)
        enter_outputs(rounds, values, gae, self.value_norm, self.value_layers, self.cfg)
        enter_targets(rounds, values, gae, self.value_norm, self.cfg, self.reduction)
        return prepared.buffer(self.rows, self.cfg, self.reduction), metrics

    @torch.no_grad()
    def prepare_again(self) -> ReplayBuffer | None:
        """Return what `prepare` returned last, with advantages and targets by the critic as it is now.

        What the policy and a clipped value are compared with stays, and so do the statistics of returns.
        """
        batch = self.prepared
        assert batch is not None, "ppo.recompute_advantages"
        values = self.reader.read_again(batch.rounds, batch.following)
        gae = batch.estimate(values, self.rewards.gammas, self.cfg)
        enter_targets(batch.rounds, values, gae, self.value_norm, self.cfg, self.reduction)
        return batch.buffer(self.rows, self.cfg, self.reduction)

    def update(self, buffer: ReplayBuffer) -> dict[str, float]:
        """Run the epochs; take everything back if a number is not finite or the KL explodes."""
        before = cloned(self._trainable_state())
        sums: dict[str, Tensor] = {}
        steps, kl_epoch, stopped = 0, 0.0, False
        for epoch in range(self.cfg.epochs):
            if epoch and self.cfg.recompute_advantages:
                buffer = self.prepare_again()
            kls = []
            for minibatch in buffer:
                minibatch = self.rows.take(minibatch)
                terms = self.step(minibatch)
                sums = {k: v + sums.get(k, 0.0) for k, v in terms.items()}
                kls.append(terms["kl"])
                steps += 1

            # one look at the KL an epoch: every look waits for the device
            kl_epoch = float(self.reduction.whole(torch.stack(kls).mean()))
            if not math.isfinite(kl_epoch) or kl_epoch > self.cfg.max_kl:
                break
            if self.cfg.target_kl is not None and kl_epoch > self.cfg.target_kl:
                stopped = True
                break

        # each step's KL is that before it: what the last one did is seen only now
        mask = minibatch.get(ACTOR_LEARNS, None)
        kl = approximate_kl(*self.loss.compare(minibatch), mask, self.reduction)
        kl_after = float(self.reduction.whole(kl))
        metrics = {name: float(self.reduction.whole(value)) / steps for name, value in sums.items()}
        healthy = all(map(math.isfinite, (*metrics.values(), kl_after)))
        healthy = healthy and all(bool(torch.isfinite(p).all()) for p in self.params)

        self.updates += 1
        rolled_back = not healthy or max(kl_epoch, kl_after) > self.cfg.max_kl
        if rolled_back:
            self._load_trainable(before)
            self.rollbacks += 1
        if not self.warmup.active:  # which moves no policy
            self.rates.steer(math.inf if rolled_back else max(kl_epoch, kl_after))

        return metrics | {
            "rolled_back": float(rolled_back),
            "kl_last": max(kl_epoch, kl_after) if healthy else kl_after,
            "kl_stopped": float(stopped),
            "rollbacks": float(self.rollbacks),
        }

    def step(self, minibatch: TensorDictBase) -> dict[str, Tensor]:
        """Take one step of the optimizer; return its terms before it: of several learners, parts."""
        if self.cfg.value_norm_update is ValueNormUpdate.minibatch:
            move_with_minibatch(self.value_norm, minibatch)
        losses = self.loss(minibatch)
        total = self.warmup.total(losses)

        self.optimizer.zero_grad()
        total.backward()
        self.reduction.add_gradients(self.params)
        grad_norm = clip_gradients(self.optimizer, self.cfg)
        self.optimizer.step()
        for net in self.bounded:
            net.project()

        with torch.no_grad():
            mask, ratio = minibatch.get(ACTOR_LEARNS, None), self.loss.ratio
            clipped = ((ratio - 1).abs() > self.loss.clip_epsilon.item()).float()
            return {
                "policy_loss": losses["loss_objective"].detach(),
                "value_loss": losses["loss_critic"].detach(),
                "entropy": self.reduction.part(self.loss.entropy, mask),
                "kl": approximate_kl(self.loss.log_ratio, ratio, mask, self.reduction),
                "clip_fraction": self.reduction.part(last_mean(clipped), mask),
                "grad_norm": grad_norm.detach() / self.reduction.size,
            }

    def _trainable_state(self) -> dict[str, Any]:
        return {
            "actor": self.actor.state_dict(),
            "critic": self.critic.state_dict(),
            "optimizer": self.optimizer.state_dict(),
        }

    def _load_trainable(self, state: dict[str, Any]) -> None:
        self.actor.load_state_dict(state["actor"])
        self.critic.load_state_dict(state["critic"])
        load_optimizer(self.optimizer, in_two_groups(state["optimizer"], len([*self.actor.parameters()])))

    def state_dict(self) -> dict[str, Any]:
        """Return everything that resuming needs."""
        state = self._trainable_state()
        if self.actor.moving_norms:  # on, while what is returned here has not been written yet
            state["actor"] = {name: value.clone() for name, value in state["actor"].items()}
        return state | {
            "value_norm": self.value_norm.state_dict(),
            "carried": self.carried.state_dict(),
            "critic_states": self.reader.state_dict(),
            "rewards": self.rewards.state_dict(),
            "cloning": None if self.cloning is None else self.cloning.state_dict(),
            "updates": self.updates,
            "rollbacks": self.rollbacks,
            "decisions": self.warmup.decisions,
            "lr_scale": self.rates.scale,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Resume from what `state_dict` returned."""
        self._load_trainable(state)
        self.value_norm.load_state_dict(by_stream(state["value_norm"]))
        self.rewards.load_state_dict(state.get("rewards", {}))
        if self.cloning is not None and state.get("cloning") is not None:
            self.cloning.load_state_dict(state["cloning"])
        self.carried.load_state_dict(state.get("carried"), self.params[0].device)
        self.reader.load_state_dict(state.get("critic_states", {}))
        self.rollbacks, self.warmup.decisions = int(state["rollbacks"]), int(state.get("decisions", 0))
        self.actor.moving_norms = self.warmup.free(self.round_norms)
        self.updates = int(state.get("updates", self.rollbacks))  # written since 0.2
        if self.cfg.lr_target_kl is not None:  # else the options have it that nothing steers
            self.rates.scale = float(state.get("lr_scale", 1.0))  # since 0.3
