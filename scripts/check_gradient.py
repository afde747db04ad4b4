#!/usr/bin/env python3
"""Show what keeps a trained policy from learning more: its critic, or the noise of its gradient.

    scripts/check_gradient.py --run RUN [--decisions 150000] [--batch-size 2560] [--gamma 0.99] [--seed 0]

It plays a checkpoint's own scene as it explores, without learning, and prints

* the variance of discounted returns that the critic explains in a quarter of the episodes, as it was trained
  and after more epochs on the other three quarters: if these gain nothing, there is nothing more to explain;
* of the squared length of the policy's gradient over one batch, the share that batches have in common (the
  mean inner product of two batches' gradients over the mean square of one). The rest is noise, which points
  elsewhere in every batch.

For scenes of one behavior whose agents have no team, see vectors, move continuously, without a memory
or traces, such as Walker.
"""

from __future__ import annotations

import argparse
import copy
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from mlagents_envs.base_env import ActionTuple
from run_script import positive, run_script
from tensordict import TensorDict
from torch import Tensor

from mappo_unity import keys
from mappo_unity.errors import ConfigError
from mappo_unity.learning.advantage import explained_variance
from mappo_unity.learning.networks.actor_critic import make_critic
from mappo_unity.learning.networks.distributions import ActionDistribution
from mappo_unity.learning.networks.encoders import ObsLayout
from mappo_unity.learning.transitions import env_actions
from mappo_unity.learning.value_norm import ValueNorm, by_stream
from mappo_unity.policies.policy import actor_of, model_from_saved
from mappo_unity.policies.policy_files import check_resumable, choose_checkpoint
from mappo_unity.runs import checkpoint
from mappo_unity.scenes.registry import make_scene

EPOCHS, FIT_RATE, FIT_BATCH = 4, 1e-4, 512
HELD_OUT = 4  # one episode of so many


class Learner:
    """Actor and critic of a checkpoint's only policy name."""

    def __init__(self, path: Path) -> None:
        state = checkpoint.load(path)
        self.env_name = str(state["env_name"])
        name, *others = state["layout"]
        layout, model = state["layout"][name], model_from_saved(state["model"][name])
        sensors = layout["sensors"]
        is_plain = not others and layout["team_size"] == 1 and model.memory.value == "none"
        is_plain = is_plain and not model.critic_traces
        if not is_plain or layout["branches"] or any(len(shape) > 1 for shape in sensors):
            raise ConfigError(
                f"run={path}: the script takes one behavior of single agents that see vectors, move "
                "continuously, without a memory or traces"
            )

        self.actor = actor_of(state, name)
        saved = state["learners"][name]
        streams = len(by_stream(saved["value_norm"])["mean"])
        self.critic = make_critic(ObsLayout.from_shapes(sensors), 1, model, self.actor.layout, streams)
        self.critic.load_state_dict(saved["critic"])
        self.norm = ValueNorm(0.99, streams=streams)
        self.norm.load_state_dict(by_stream(saved["value_norm"]))

    def act(self, obs: Tensor) -> Tensor:
        """Return actions ``[n, C]`` as it explores, before they are limited."""
        return self.actor.draw(TensorDict({keys.OBS: obs}, [len(obs)])).action

    def gradient(self, obs: Tensor, actions: Tensor, advantages: Tensor) -> Tensor:
        """Return the gradient ``[P]`` of the advantages' mean, each times its action's log-probability."""
        weights = [weight for weight in self.actor.parameters() if weight.requires_grad]
        dist = ActionDistribution(self.actor.module[0].module(obs), self.actor.layout)
        parts = torch.autograd.grad((dist.log_prob(actions) * advantages).mean(), weights)
        return torch.cat([part.flatten() for part in parts])

    def values(self, obs: Tensor, critic: torch.nn.Module | None = None) -> Tensor:
        """Return values of the environment's rewards ``[n]`` for observations ``[n, O]``."""
        net = self.critic.module if critic is None else critic
        with torch.no_grad():
            outputs = torch.cat([net(rows.unsqueeze(1)).squeeze(1) for rows in obs.split(8192)])
        return self.norm.denormalize(outputs)[:, 0]


@dataclass
class Episode:
    """What an agent saw, did and earned; `end_value` stands for what would have followed."""

    obs: list[Tensor] = field(default_factory=list)
    actions: list[Tensor] = field(default_factory=list)
    values: list[float] = field(default_factory=list)
    rewards: list[float] = field(default_factory=list)
    end_value: float = 0.0

    def deltas(self, gamma: float) -> np.ndarray:
        """Return each decision's reward and the next value over its own value."""
        following = np.append(self.values[1:], self.end_value)
        return np.array(self.rewards) + gamma * following - np.array(self.values)


def play(learner: Learner, num_areas: int, decisions: int, seed: int) -> list[Episode]:
    """Return the episodes of so many decisions; those that are still open end with the critic's value."""
    env = make_scene(learner.env_name, seed=seed, num_areas=num_areas)
    env.reset()
    (behavior,) = env.behavior_specs
    ended: list[Episode] = []
    running: dict[int, Episode] = {}
    count = 0

    while count < decisions:
        asking, ends = env.get_steps(behavior)
        for row, agent in enumerate(ends.agent_id):
            episode = running.pop(int(agent), None)
            if episode is None:
                continue  # it had not decided anything
            episode.rewards.append(float(ends.reward[row]))
            if ends.interrupted[row]:
                last = torch.from_numpy(np.concatenate([x[row] for x in ends.obs]))
                episode.end_value = float(learner.values(last.unsqueeze(0)))
            ended.append(episode)

        if len(asking):
            obs = torch.from_numpy(np.concatenate(asking.obs, 1))
            actions, values = learner.act(obs), learner.values(obs)
            for row, agent in enumerate(asking.agent_id):
                episode = running.setdefault(int(agent), Episode())
                if episode.obs:
                    episode.rewards.append(float(asking.reward[row]))
                episode.obs.append(obs[row])
                episode.actions.append(actions[row])
                episode.values.append(float(values[row]))
            played = env_actions(actions, learner.actor.layout)
            env.set_actions(behavior, ActionTuple(continuous=played.numpy()))
            count += len(asking)
        env.step()

    for episode in running.values():  # the outcome of the last decision is not known yet
        episode.end_value = episode.values.pop()
        episode.obs.pop()
        episode.actions.pop()
    return ended + [episode for episode in running.values() if episode.obs]


def discounted(steps: np.ndarray, decay: float, last: float = 0.0) -> np.ndarray:
    """Return the sums of what follows each step, every step later counted `decay` times less."""
    sums = np.zeros(len(steps))
    for i in range(len(steps) - 1, -1, -1):
        last = sums[i] = steps[i] + decay * last
    return sums


def show_critic(learner: Learner, episodes: list[Episode], gamma: float) -> None:
    """Print what the critic explains, and what it would after more epochs on the same policy's episodes."""
    obs = [torch.stack(episode.obs) for episode in episodes]
    returns = [
        torch.from_numpy(discounted(np.array(e.rewards), gamma, e.end_value)).float() for e in episodes
    ]
    held, known = (
        [
            torch.cat([x for i, x in enumerate(parts) if (i % HELD_OUT == 0) is is_held])
            for parts in (obs, returns)
        ]
        for is_held in (True, False)
    )

    every = torch.ones_like(held[1], dtype=torch.bool)
    value = explained_variance(learner.values(held[0]), held[1], every)
    print(f"critic, explained variance as trained: {value:.3f}")

    critic = copy.deepcopy(learner.critic.module).train()
    optimizer = torch.optim.Adam(critic.parameters(), lr=FIT_RATE)
    targets = learner.norm.normalize(known[1].unsqueeze(-1))[:, :1]  # of the environment's rewards
    for epoch in range(1, EPOCHS + 1):
        for rows in torch.randperm(len(targets)).split(FIT_BATCH):
            loss = ((critic(known[0][rows].unsqueeze(1)).squeeze(1)[:, :1] - targets[rows]) ** 2).mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
        value = explained_variance(learner.values(held[0], critic), held[1], every)
        print(f"after {epoch} more epochs on {len(targets):,} decisions of this policy: {value:.3f}")


def show_gradient(learner: Learner, episodes: list[Episode], options: argparse.Namespace) -> None:
    """Print what the policy's gradients of single batches have in common."""
    obs = torch.cat([torch.stack(episode.obs) for episode in episodes])
    actions = torch.cat([torch.stack(episode.actions) for episode in episodes])
    decay = options.gamma * options.gae_lambda
    parts = [discounted(episode.deltas(options.gamma), decay) for episode in episodes]
    advantages = torch.from_numpy(np.concatenate(parts)).float()
    advantages = (advantages - advantages.mean()) / advantages.std()

    # an episode's decisions share their luck: they stay together, and no pair is of neighbours
    batches = torch.arange(len(obs)).split(options.batch_size)[:-1]
    gradients = torch.stack([learner.gradient(obs[b], actions[b], advantages[b]) for b in batches])
    half = len(gradients) // 2
    pairs = (gradients[:half] * gradients[half : 2 * half]).sum(1)
    square = (gradients**2).sum(1).mean()
    share, error = pairs.mean() / square, pairs.std() / len(pairs) ** 0.5 / square
    print(
        f"policy's gradient over {options.batch_size:,} decisions: {share:.2%} of its square is common to "
        f"batches (standard error {error:.2%}, {len(pairs)} pairs)"
    )


def main() -> None:
    """Play, and print both."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--run", required=True, help="a run folder or a checkpoint")
    parser.add_argument("--decisions", type=positive, default=150_000)
    parser.add_argument("--batch-size", type=positive, default=2560)
    parser.add_argument("--num-areas", type=positive, default=64)
    parser.add_argument("--gamma", type=float, default=0.99)
    parser.add_argument("--gae-lambda", type=float, default=0.95)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    if options.decisions < 4 * options.batch_size:
        raise ConfigError(
            f"--decisions {options.decisions} must be at least four batches of {options.batch_size}"
        )

    torch.manual_seed(options.seed)
    torch.set_num_threads(1)
    check_resumable(Path(options.run), "run")
    learner = Learner(choose_checkpoint(Path(options.run)))
    episodes = play(learner, options.num_areas, options.decisions, options.seed)
    print(f"{sum(len(e.obs) for e in episodes):,} decisions in {len(episodes):,} episodes")
    show_critic(learner, episodes, options.gamma)
    show_gradient(learner, episodes, options)


if __name__ == "__main__":
    run_script(main)
