"""The reward streams of a policy: the environment's own, and intrinsic ones.

Every stream has a discount and a value of its own. Intrinsic ones are asked for rewards before an update and
taught after it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from mappo_unity import keys
from mappo_unity.config.schema import Config, ImageKind, IntrinsicConfig, PPOConfig, RewardsConfig, Schedule
from mappo_unity.learning.advantage import part_over, scheduled, share_left
from mappo_unity.learning.decisions import DecisionView
from mappo_unity.learning.imitation.expert import Expert
from mappo_unity.learning.networks.distributions import ActionLayout
from mappo_unity.learning.networks.encoders import ObsLayout, RunningNorm, running_norms
from mappo_unity.learning.networks.images import OURS
from mappo_unity.learning.optimizer import load_optimizer
from mappo_unity.learning.rewards.curiosity import Curiosity
from mappo_unity.learning.rewards.gail import Discriminator
from mappo_unity.learning.rewards.rnd import RandomNetwork
from mappo_unity.learning.transitions import Transitions, find_transitions

EXTRINSIC = "extrinsic"
ROWS = 4096  # decisions that are judged at once: images of a whole batch would not fit into memory


class IntrinsicStream:
    """An intrinsic reward with its optimizer and its scale.

    Args:
        name: of the stream, as in the options.
        model: has ``rewards(decisions)``, float32 ``[D]``, and ``loss(decisions)``, a scalar.
        cfg: the stream's options.
        max_steps: agent decisions of the run.

    Attributes: `left`, share of the strength that is left; once it is 0, nothing is earned and learnt.
    """

    def __init__(self, name: str, model: nn.Module, cfg: IntrinsicConfig, max_steps: int = 0) -> None:
        self.name, self.cfg, self._max_steps, self.left = name, cfg, max_steps, 1.0
        self.model: Any = model
        learns = [parameter for parameter in model.parameters() if parameter.requires_grad]
        self.optimizer = torch.optim.Adam(learns, lr=cfg.lr)
        self.norms = running_norms(model)
        self.returns = RunningNorm(1)  # of discounted sums of the reward
        self.returns.epsilon = 1e-12  # a predictor's errors become small

    def begin(self, progress: float) -> dict[str, float]:
        """Set the strength of the update that begins, after this share of the run; return a metric of it."""
        self.left = share_left(self.cfg.steps, self._max_steps, progress)
        return {f"{self.name}_strength": self.cfg.strength * self.left} if self.cfg.steps else {}

    @torch.no_grad()
    def rewards(self, decisions: Transitions, view: DecisionView) -> tuple[Tensor, dict[str, float]]:
        """Return the rewards of decisions, float32 ``[R * N]`` (0 where there is none), and metrics.

        Args:
            decisions: of the view's batch.
            view: ``[R, N]``.
        """
        reward = torch.zeros(view.valued.size, device=decisions.at.device)
        if not len(decisions) or not self.left:
            return reward, {}

        # vectors are known before they are judged: nothing here must stand still during an update
        if self.norms:
            vectors = decisions.table[0][decisions.at]  # `obs` would gather images, too
            for norm in self.norms:
                norm.update(vectors)

        everything = torch.arange(len(decisions), device=decisions.at.device)
        parts = [self.model.rewards(decisions[index]) for index in everything.split(ROWS)]
        reward[decisions.at] = torch.cat(parts)

        if self.cfg.normalize:
            self._scale(reward, decisions, view)
        mean = float(reward[decisions.at].mean())
        return self.cfg.strength * self.left * reward, {f"{self.name}_reward": mean}

    def _scale(self, reward: Tensor, decisions: Transitions, view: DecisionView) -> None:
        """Divide rewards by the deviation of their discounted sums (Burda et al., section 2.4)."""
        sums = view.scan(reward.cpu().numpy().reshape(view.valued.shape), self.cfg.gamma)
        rows = torch.from_numpy(sums).flatten()[decisions.at.cpu()]
        self.returns.update(rows.unsqueeze(-1))
        reward.mul_(float(self.returns.inv_std))

    def learn(self, decisions: Transitions, cfg: PPOConfig) -> dict[str, float]:
        """Teach the model these decisions, in minibatches of `ppo.minibatch_size`; return metrics."""
        if not self.left:
            return {}

        losses = []
        for _ in range(cfg.epochs):
            order = torch.randperm(len(decisions)).to(decisions.at.device)
            for index in order.split(cfg.minibatch_size):
                loss = self.model.loss(decisions[index])
                self.optimizer.zero_grad()
                loss.backward()
                self.optimizer.step()
                losses.append(loss.detach())
        return {f"{self.name}_loss": float(torch.stack(losses).mean())}

    def state_dict(self) -> dict[str, Any]:
        """Return what resuming needs."""
        parts = {"model": self.model, "optimizer": self.optimizer, "returns": self.returns}
        return {name: part.state_dict() for name, part in parts.items()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        self.model.load_state_dict(state["model"])
        load_optimizer(self.optimizer, state["optimizer"])
        self.returns.load_state_dict(state["returns"])


class RewardStreams:
    """All streams of a policy, the environment's own first.

    Args:
        ppo: the learner's options.
        cfg: the streams' options; None: the environment's rewards alone.
        intrinsic: the other streams.
        obs_keys: the observation entries that they look at.
        shares: members of a team earn what all of them earn together: MA-POCA's value is the team's.
    """

    def __init__(
        self,
        ppo: PPOConfig,
        cfg: RewardsConfig | None = None,
        intrinsic: Sequence[IntrinsicStream] = (),
        obs_keys: Sequence[str] = (),
        shares: bool = False,
    ) -> None:
        own = (cfg or RewardsConfig()).extrinsic
        self._ppo, self._shares, self._obs_keys = ppo, shares, list(obs_keys)
        self.intrinsic = list(intrinsic)
        self.names = [EXTRINSIC, *(stream.name for stream in intrinsic)]
        self.gammas = [ppo.gamma if own.gamma is None else own.gamma, *(s.cfg.gamma for s in intrinsic)]
        self._moves_gamma = own.gamma is None and ppo.gamma_schedule is not Schedule.constant
        self._weights = [(keys.REWARD, own.strength * ppo.reward_weight)]
        self._weights += [(keys.GROUP_REWARD, own.strength * ppo.group_reward_weight)]
        self._decisions: Transitions | None = None  # of the batch in hand, until it is learnt

    def begin(self, progress: float) -> dict[str, float]:
        """Set discount and strengths of an update after this share of the run; return those that move."""
        settings: dict[str, float] = {}
        if self._moves_gamma:
            ppo = self._ppo
            over = part_over(progress, ppo.gamma_from, ppo.gamma_until)
            self.gammas[0] = scheduled(ppo.gamma_schedule, ppo.gamma, ppo.gamma_final, over)
            settings["gamma"] = self.gammas[0]
        for stream in self.intrinsic:
            settings |= stream.begin(progress)
        return settings

    def rewards(
        self, rounds: TensorDict, following: TensorDictBase, view: DecisionView
    ) -> tuple[Tensor, dict[str, float]]:
        """Return the rewards of all streams, float32 ``[R, ..., A, V]``, and metrics.

        Args:
            rounds: ``[R, ..., A]``, as `CarriedRounds.join` returns them.
            following: what was seen after them, see `find_transitions`.
            view: of the rounds.
        """
        own, group = (weight * rounds.get(key) for key, weight in self._weights)
        if not self.intrinsic:
            return own + group, {}

        self._decisions = find_transitions(rounds, following, view, self._obs_keys)
        columns, metrics = [own + group], dict[str, float]()
        for stream in self.intrinsic:
            reward, told = stream.rewards(self._decisions, view)
            reward = reward.view_as(own)
            columns.append(reward.sum(-2, keepdim=True).expand_as(own) if self._shares else reward)
            metrics |= told
        return torch.cat(columns, -1), metrics

    def learn(self) -> dict[str, float]:
        """Teach the intrinsic streams the batch that was asked about last; return metrics."""
        metrics: dict[str, float] = {}
        for stream in self.intrinsic:
            if self._decisions is not None and len(self._decisions):
                metrics |= stream.learn(self._decisions, self._ppo)
        self._decisions = None
        return metrics

    def state_dict(self) -> dict[str, Any]:
        """Return what resuming needs."""
        return {stream.name: stream.state_dict() for stream in self.intrinsic}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        for stream in self.intrinsic:
            stream.load_state_dict(state[stream.name])


def make_intrinsic(
    obs: ObsLayout,
    layout: ActionLayout,
    cfg: RewardsConfig,
    run: Config,
    expert: Expert | None = None,
    images: ImageKind = ImageKind.auto,
) -> list[IntrinsicStream]:
    """Build the intrinsic streams that are on.

    Args:
        obs, layout: what an agent observes and does.
        cfg: the streams' options.
        run: the options of the run: its device and its length.
        expert: the demonstrations, where GAIL is on.
        images: the encoder of the policy's images.
    """
    models = make_models(obs, layout, cfg, expert, images)
    return [
        IntrinsicStream(name, model.to(run.device), cfg.intrinsic[name], run.max_steps)
        for name, model in models.items()
    ]


def make_models(
    obs: ObsLayout,
    layout: ActionLayout,
    cfg: RewardsConfig,
    expert: Expert | None = None,
    images: ImageKind = ImageKind.auto,
) -> dict[str, nn.Module]:
    """Build the models of the streams that are on; GAIL's learns only with an expert.

    They see images as the policy does where that takes an encoder of ours, else through `ImageKind.auto`.
    """
    seen = images if images in OURS else ImageKind.auto
    models: dict[str, nn.Module] = {}
    if "curiosity" in cfg.intrinsic:
        models["curiosity"] = Curiosity(obs, layout, cfg.curiosity, seen)
    if "rnd" in cfg.intrinsic:
        models["rnd"] = RandomNetwork(obs, layout, cfg.rnd, seen)
    if "gail" in cfg.intrinsic:
        models["gail"] = Discriminator(obs, layout, cfg.gail, expert, seen)
    return models
