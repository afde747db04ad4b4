"""Policies that act on DecisionSteps: a trained checkpoint, or chance."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import fields
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from mlagents_envs.base_env import ActionSpec, ActionTuple, BehaviorSpec, DecisionSteps
from omegaconf import OmegaConf
from tensordict import TensorDict

from mappo_unity import keys
from mappo_unity.config.schema import ModelConfig, bounded_log_std
from mappo_unity.learning.networks.actor_critic import PerMember, make_actor
from mappo_unity.learning.networks.distributions import CONTINUOUS_LIMIT, ActionLayout
from mappo_unity.learning.networks.encoders import ObsLayout
from mappo_unity.policies.layouts import CHANNELS, GOALS, check_layout
from mappo_unity.policies.members import MemberTable, Places, team_places
from mappo_unity.runs import checkpoint


class Policy(Protocol):
    """Choose actions for the agents of an environment's behaviors."""

    def check(self, behavior: str, spec: BehaviorSpec) -> None:
        """Raise ConfigError if this policy cannot play that behavior."""
        ...

    def forget(self, behavior: str, agent_ids: Iterable[int]) -> None:
        """Drop the memory of agents that begin an episode."""
        ...

    def end(self, behavior: str, agent_ids: Iterable[int]) -> None:
        """Take note that episodes of these agents have ended, before the next `act`."""
        ...

    def act(self, behavior: str, steps: DecisionSteps, spec: BehaviorSpec) -> ActionTuple:
        """Return an action for every row of ``steps``, in their order."""
        ...


class RandomPolicy:
    """Uniform actions from a seed: [-1, 1] for continuous ones, allowed branches for discrete ones."""

    def __init__(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)

    def check(self, behavior: str, spec: BehaviorSpec) -> None:
        """Accept every behavior."""

    def forget(self, behavior: str, agent_ids: Iterable[int]) -> None:
        """Remember nothing."""

    def end(self, behavior: str, agent_ids: Iterable[int]) -> None:
        """Remember nothing."""

    def act(self, behavior: str, steps: DecisionSteps, spec: BehaviorSpec) -> ActionTuple:
        """Return an action for every row of ``steps``."""
        action, count = ActionTuple(), len(steps)
        size, branches = spec.action_spec.continuous_size, spec.action_spec.discrete_branches

        if size:
            action.add_continuous(self.rng.uniform(-1, 1, (count, size)).astype(np.float32))
        if branches:
            # A mask is True where a branch is forbidden; such a branch scores below every draw.
            masks = steps.action_mask or [np.zeros((count, n), bool) for n in branches]
            scores = [np.where(np.asarray(m, bool), -1.0, self.rng.random(m.shape)) for m in masks]
            action.add_discrete(np.stack([s.argmax(1) for s in scores], 1).astype(np.int32))

        return action


class ActorPolicy:
    """Actors of policy names, as they are now.

    Args:
        layout: what each was built for, as `describe_spec` returns it.
        actors: the networks by policy name.
        deterministic: take the most likely action.
        name: what to call them in errors.
    """

    def __init__(
        self, layout: dict[str, Any], actors: dict[str, Any], deterministic: bool, name: str
    ) -> None:
        self.layout, self.actors, self.deterministic, self.name = layout, actors, deterministic, name
        # where every member has a network of its own, an agent must stay the member that it is
        self._per_member = {
            name
            for name, actor in actors.items()
            if any(isinstance(part, PerMember) for part in actor.modules())
        }
        self._members: dict[str, MemberTable] = {}
        self._memories: dict[str, dict[int, np.ndarray]] = {}  # states [M] of each behavior's agents

    @torch.no_grad()
    def act(self, behavior: str, steps: DecisionSteps, spec: BehaviorSpec) -> ActionTuple:
        """Return an action for every row of ``steps``."""
        name = keys.policy_name(behavior)
        self.check(behavior, spec)

        places = self._places(behavior, steps)
        device = next(self.actors[name].parameters()).device
        inputs = _inputs(steps, spec)
        if self.actors[name].has_memory:
            inputs[keys.MEMORY] = self._remembered(behavior, steps.agent_id, self.actors[name].memory_size)
        entries = {k: _spread(v, places).to(device) for k, v in inputs.items()}

        drawn = self.actors[name].draw(TensorDict(entries, places.shape), self.deterministic)
        if drawn.memory is not None:
            after = drawn.memory.cpu().numpy()[places.teams, places.members]
            self._memories[behavior].update(zip(steps.agent_id.tolist(), after))

        # Back to the rows of `steps`: the network gives whole teams, with their empty places.
        chosen = drawn.action.cpu().numpy()[places.teams, places.members]
        size, action = spec.action_spec.continuous_size, ActionTuple()
        if size:
            scaled = np.clip(chosen[:, :size], -CONTINUOUS_LIMIT, CONTINUOUS_LIMIT) / CONTINUOUS_LIMIT
            action.add_continuous(scaled.astype(np.float32))
        if spec.action_spec.discrete_size:
            action.add_discrete(chosen[:, size:].astype(np.int32))

        return action

    def check(self, behavior: str, spec: BehaviorSpec) -> None:
        """Raise ConfigError if this policy cannot play that behavior."""
        check_layout(self.name, self.layout, behavior, spec)

    def forget(self, behavior: str, agent_ids: Iterable[int]) -> None:
        """Drop the memory of agents that begin an episode."""
        for agent in agent_ids:
            self._memories.get(behavior, {}).pop(int(agent), None)

    def _remembered(self, behavior: str, agent_ids: np.ndarray, size: int) -> np.ndarray:
        """Return the states ``[n, M]`` of agents, zero for those that act for the first time."""
        known = self._memories.setdefault(behavior, {})
        nothing = np.zeros(size, np.float32)
        return np.stack([known.get(agent, nothing) for agent in agent_ids.tolist()])

    def end(self, behavior: str, agent_ids: Iterable[int]) -> None:
        """Take note that the places of these agents may be given to new members of their teams."""
        if behavior in self._members:
            self._members[behavior].end(agent_ids)

    def _places(self, behavior: str, steps: DecisionSteps) -> Places:
        name = keys.policy_name(behavior)
        if name not in self._per_member:
            # one network for all members plays in teams of any size
            return team_places(steps.group_id)
        team_size = self.layout[name]["team_size"]
        table = self._members.setdefault(behavior, MemberTable(team_size))
        return table.places(steps.agent_id, steps.group_id)


class CheckpointPolicy(ActorPolicy):
    """The actors of a checkpoint.

    Raises:
        CheckpointError: the file cannot be read.
    """

    def __init__(self, path: Path, deterministic: bool) -> None:
        state = checkpoint.load(path)
        actors = {name: actor_of(state, name) for name in state["layout"]}
        super().__init__(state["layout"], actors, deterministic, f"checkpoint {path}")
        self.path = path
        self.agent_steps = int(state["agent_steps"])


def _inputs(steps: DecisionSteps, spec: BehaviorSpec) -> dict[str, np.ndarray]:
    """The entries of a network's input, a row for each agent."""
    shapes = [o.shape for o in spec.observation_specs]
    entries = {keys.SENSOR.format(i): o for i, o in enumerate(steps.obs) if len(shapes[i]) != 1}

    vectors = [o for o, shape in zip(steps.obs, shapes) if len(shape) == 1]
    if vectors:
        entries[keys.OBS] = np.concatenate(vectors, 1).astype(np.float32)

    # ML-Agents marks what is forbidden, the network takes what is allowed.
    if spec.action_spec.discrete_size:
        count, total = len(steps), sum(spec.action_spec.discrete_branches)
        forbidden = np.concatenate(steps.action_mask, 1) if steps.action_mask else np.zeros((count, total))
        entries[keys.MASK] = ~forbidden.astype(bool)

    return entries


def _spread(rows: np.ndarray, places: Places) -> torch.Tensor:
    """Rows ``[n, ...]`` to ``[G, A, ...]``; empty places hold zeros, or True in masks."""
    fill = np.ones if rows.dtype == bool else np.zeros
    out = fill((*places.shape, *rows.shape[1:]), rows.dtype)
    out[places.teams, places.members] = rows
    return torch.from_numpy(out)


def actor_of(state: dict[str, Any], name: str) -> Any:
    """Return the actor of a policy name that a loaded checkpoint holds."""
    layout, model = state["layout"][name], model_from_saved(state["model"][name])
    actions = ActionLayout.from_spec(
        ActionSpec(layout["continuous"], tuple(layout["branches"])), model.flatten_branches
    )

    # what an older checkpoint does not tell is guessed, as it was then
    obs = ObsLayout.from_shapes(layout["sensors"], layout.get(CHANNELS), layout.get(GOALS))
    actor = make_actor(obs, actions, layout["team_size"], model)
    actor.load_state_dict(state["learners"][name]["actor"])
    return actor.eval()


def model_from_saved(saved: dict[str, Any]) -> ModelConfig:
    """Return the model options that a checkpoint holds; those that it does not know have their defaults."""
    known = {field.name: saved[field.name] for field in fields(ModelConfig) if field.name in saved}
    if "init_log_std" in known:
        known["init_log_std"] = bounded_log_std(known["init_log_std"])
    model = OmegaConf.to_object(OmegaConf.merge(OmegaConf.structured(ModelConfig), known))
    assert isinstance(model, ModelConfig)
    return model
