"""Things that act on DecisionSteps: a trained checkpoint, or chance.

In: the records of a BaseEnv. Out: ActionTuples. Used to play, not to learn.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from mlagents_envs.base_env import ActionTuple, BehaviorSpec, DecisionSteps
from tensordict import TensorDict
from torchrl.envs import ExplorationType, set_exploration_type

from mappo_unity import checkpoint, keys
from mappo_unity.actions import CONTINUOUS_LIMIT, ActionLayout
from mappo_unity.config import Activation, ConfigError, ModelConfig
from mappo_unity.models import make_actor


class Policy(Protocol):
    """Choose actions for the agents of one behavior."""

    def act(self, behavior: str, steps: DecisionSteps, spec: BehaviorSpec) -> ActionTuple:
        """Return an action for every row of ``steps``, in their order."""
        ...


class RandomPolicy:
    """Uniform actions from a seed: [-1, 1] for continuous ones, allowed branches for discrete ones."""

    def __init__(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)

    def act(self, behavior: str, steps: DecisionSteps, spec: BehaviorSpec) -> ActionTuple:
        """Return an action for every row of ``steps``."""
        action, count = ActionTuple(), len(steps)
        size, branches = spec.action_spec.continuous_size, spec.action_spec.discrete_branches
        if size:
            action.add_continuous(self.rng.uniform(-1, 1, (count, size)).astype(np.float32))
        if branches:
            masks = steps.action_mask or [np.zeros((count, n), bool) for n in branches]
            scores = [np.where(np.asarray(m, bool), -1.0, self.rng.random(m.shape)) for m in masks]
            action.add_discrete(np.stack([s.argmax(1) for s in scores], 1).astype(np.int32))
        return action


class CheckpointPolicy:
    """The actors of a checkpoint.

    Raises:
        CheckpointError: the file cannot be read.
    """

    def __init__(self, path: Path, deterministic: bool) -> None:
        state = checkpoint.load(path)
        self.path, self.deterministic = path, deterministic
        self.agent_steps = int(state["agent_steps"])
        self.layout = state["layout"]
        model = model_config(state["model"])
        self.actors = {name: _actor(state, name, model) for name in self.layout}

    @torch.no_grad()
    def act(self, behavior: str, steps: DecisionSteps, spec: BehaviorSpec) -> ActionTuple:
        """Return an action for every row of ``steps``."""
        name = keys.policy_name(behavior)
        self.check(behavior, spec)
        obs = torch.from_numpy(np.concatenate(steps.obs, 1).astype(np.float32))
        entries = {keys.OBS: obs}
        if steps.action_mask is not None:
            entries[keys.MASK] = torch.from_numpy(~np.concatenate(steps.action_mask, 1).astype(bool))
        kind = ExplorationType.DETERMINISTIC if self.deterministic else ExplorationType.RANDOM
        with set_exploration_type(kind):
            chosen = self.actors[name](TensorDict(entries, [len(steps)])).get(keys.ACTION).numpy()
        size, action = spec.action_spec.continuous_size, ActionTuple()
        if size:
            scaled = np.clip(chosen[:, :size], -CONTINUOUS_LIMIT, CONTINUOUS_LIMIT) / CONTINUOUS_LIMIT
            action.add_continuous(scaled.astype(np.float32))
        if spec.action_spec.discrete_size:
            action.add_discrete(chosen[:, size:].astype(np.int32))
        return action

    def check(self, behavior: str, spec: BehaviorSpec) -> None:
        """Raise ConfigError if this policy cannot play that behavior."""
        name = keys.policy_name(behavior)
        known = self.layout.get(name)
        found = describe_spec(spec)
        if known != found:
            raise ConfigError(
                f"checkpoint {self.path} cannot play {behavior!r}: it was trained for {self.layout}, "
                f"but the environment has {found}"
            )


def describe_spec(spec: BehaviorSpec) -> dict[str, Any]:
    """Return what a network must fit: sensor shapes and actions."""
    return {
        "sensors": [list(o.shape) for o in spec.observation_specs],
        "continuous": int(spec.action_spec.continuous_size),
        "branches": [int(n) for n in spec.action_spec.discrete_branches],
    }


def model_config(saved: dict[str, Any]) -> ModelConfig:
    """Return the model options that a checkpoint holds."""
    options = dict(saved)
    options["activation"] = Activation(options["activation"])
    return ModelConfig(**options)


def _actor(state: dict[str, Any], name: str, model: ModelConfig) -> Any:
    layout = state["layout"][name]
    actions = ActionLayout(layout["continuous"], tuple(layout["branches"]))
    actor = make_actor(sum(shape[0] for shape in layout["sensors"]), actions, model)
    actor.load_state_dict(state["learners"][name]["actor"])
    return actor.eval()
