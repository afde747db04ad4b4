#!/usr/bin/env python3
"""Measure the learner's update against a hand-written one: same batch, networks and minibatch size.

The hand-written loop is plain PyTorch: it indexes tensors, calls the networks, adds the losses, clips and
steps; no TensorDict, no replay buffer, no metrics, no guard that takes an update back. Both take turns in one
process, so that the ratios hold on a machine that is shared. Ratio: seconds by hand over ours; 1 is as fast.

    python scripts/bench_update.py [--repeats 9] [3DBall SoccerTwos Hallway]
"""

from __future__ import annotations

import argparse
import os
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from run_script import positive, run_script
from torch import Tensor, nn
from torch.distributions import Categorical, Normal

from mappo_unity import keys
from mappo_unity.config.compose import compose_config
from mappo_unity.config.schema import Config
from mappo_unity.training.setup import set_up

OPTIONS = {"Hallway": ["model.memory=lstm"]}


def main() -> None:
    """Measure each scene's preset (Hallway's with an LSTM) and print a line for it."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenes", nargs="*", default=["3DBall", "SoccerTwos", "Hallway"])
    parser.add_argument("--repeats", type=positive, default=9)
    arguments = parser.parse_args()

    print(f"load average {os.getloadavg()[0]:.2f}, {os.cpu_count()} cores, one torch thread")
    for scene in arguments.scenes:
        lines = [f"env={scene}", "update_threads=1", *OPTIONS.get(scene, [])]
        measure(compose_config(lines).config, arguments.repeats)


def measure(cfg: Config, repeats: int) -> None:
    """Compare both updates on a batch of a scene."""
    with tempfile.TemporaryDirectory() as out, set_up(cfg, Path(out)) as setup, setup.collecting() as batches:
        name, learner = next(iter(setup.learners.items()))
        buffer, _ = learner.prepare(*next(batches).of(name))
        assert buffer is not None
        rows = learner.rows.take(buffer[:])
        by_hand = HandWritten(learner, rows)

        learner.update(buffer)
        by_hand.update()
        ours, theirs, ratios = [], [], []
        for _ in range(repeats):
            ours.append(timed(lambda: learner.update(buffer)))
            theirs.append(timed(by_hand.update))
            ratios.append(theirs[-1] / ours[-1])

    print(
        f"{cfg.env.name}: update of {len(rows)} rows, {cfg.ppo.epochs} epochs: "
        f"{statistics.median(ours) * 1e3:.0f} ms; hand-written {statistics.median(theirs) * 1e3:.0f} ms; "
        f"speed ratio {statistics.median(ratios):.2f} ({min(ratios):.2f} to {max(ratios):.2f})"
    )


class HandWritten:
    """A PPO update in plain PyTorch over rows that were prepared: team rows, or padded sequences."""

    def __init__(self, learner: Any, rows: Any) -> None:
        self.cfg, self.layout = learner.cfg, learner.actor.layout
        self.actor, self.critic = learner.actor[0].module, learner.critic.module
        self.params = [*self.actor.parameters(), *self.critic.parameters()]
        self.optimizer = torch.optim.Adam(self.params, self.cfg.lr, eps=1e-5, fused=True)
        self.has_memory = learner.actor.has_memory

        # everything as plain tensors; a minibatch is an index into each
        self.data = {str(k): v for k, v in rows.items() if isinstance(v, Tensor)}
        self.team = {str(k): v for k, v in rows.get("team", {}).items()} if self.has_memory else {}
        self.actor_keys, self.critic_keys = learner.actor.obs_keys, learner.reader.keys
        self.mask = self.data.get("actor_learns")
        decisions = rows.numel() if self.mask is None else int(self.mask.sum())
        self.count = max(1, round(decisions / self.cfg.minibatch_size))

    def update(self) -> None:
        """Run the epochs."""
        size = -(-len(self.data[keys.ACTION]) // self.count)
        for _ in range(self.cfg.epochs):
            for index in torch.randperm(len(self.data[keys.ACTION])).split(size):
                self.step({k: v[index] for k, v in self.data.items()}, index)

    def step(self, rows: dict[str, Tensor], index: Tensor) -> None:
        """Take one step of the optimizer."""
        obs = [rows[key] for key in self.actor_keys]
        params = self.actor.unroll(*obs, rows[keys.MEMORY]) if self.has_memory else self.actor(*obs)
        log_prob, entropy = self.evaluate(params, rows)
        ratio = (log_prob - rows[keys.LOG_PROB]).exp()
        gain, clip = rows[keys.ADVANTAGE].squeeze(-1), self.cfg.clip_epsilon
        policy = -torch.minimum(ratio * gain, ratio.clamp(1 - clip, 1 + clip) * gain)

        if self.has_memory:
            team = [self.team[key][index] for key in self.critic_keys]
            value, _ = self.critic.unroll(team, None, rows["member"], rows)
        else:
            value = self.critic(*[rows[key] for key in self.critic_keys])
        error = nn.functional.huber_loss(
            value, rows[keys.VALUE_TARGET], reduction="none", delta=self.cfg.huber_delta
        ).squeeze(-1)

        loss = policy + self.cfg.value_coef * error - self.cfg.entropy_coef * entropy
        if self.mask is not None:
            weight = rows["actor_learns"].squeeze(-1).float()
            total = (loss * weight).sum() / weight.sum().clamp_min(1)
        else:
            total = loss.mean()

        self.optimizer.zero_grad()
        total.backward()
        nn.utils.clip_grad_norm_(self.params, self.cfg.max_grad_norm or 1e9, foreach=True)
        self.optimizer.step()

    def evaluate(self, params: Tensor, rows: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
        """Return log-probabilities and entropies ``[...]`` of the actions."""
        size = self.layout.continuous
        log_prob = entropy = torch.zeros(())
        if size:
            dist = Normal(params[..., :size], params[..., size : 2 * size].exp(), validate_args=False)
            log_prob = dist.log_prob(rows[keys.ACTION][..., :size]).sum(-1)
            entropy = dist.entropy().sum(-1)
        if not self.layout.branches:
            return log_prob, entropy

        logits = params[..., 2 * size :].masked_fill(~self.layout.joint_mask(rows[keys.MASK]), -1e8)
        chosen = self.layout.to_categories(rows[keys.ACTION][..., size:].long())
        for column, part in enumerate(logits.split(list(self.layout.categoricals), -1)):
            branch = Categorical(logits=part, validate_args=False)
            log_prob = log_prob + branch.log_prob(chosen[..., column])
            entropy = entropy + branch.entropy()
        return log_prob, entropy


def timed(work: Callable[[], Any]) -> float:
    """Return the seconds that ``work()`` takes."""
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


if __name__ == "__main__":
    torch.set_num_threads(1)
    run_script(main)
