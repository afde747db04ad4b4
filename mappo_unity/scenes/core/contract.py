"""The contract of a `BaseEnv`, as a checker that any environment can be run against.

In: an environment, or a scene's name on the command line. Out: a summary, or `ContractError` that names
the behavior, the agent and what is wrong. Knows nothing of any scene.

    python -m mappo_unity.scenes.check 3DBall [--steps 500] [--num-areas 4]
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from mlagents_envs.base_env import ActionTuple, BaseEnv, BehaviorSpec, DecisionSteps, TerminalSteps

from mappo_unity.config.schema import ConfigError
from mappo_unity.scenes import make_scene, scene_names


class ContractError(AssertionError):
    """A broken rule of the BaseEnv contract."""


@dataclass
class Report:
    """Count what a checked run has seen."""

    steps: int = 0
    decisions: int = 0
    terminals: int = 0
    interrupted: int = 0
    terminal_only_steps: int = 0
    checks: list[str] = field(default_factory=list)


@dataclass
class _Agent:
    behavior: str
    group_id: int
    ended: bool = False


def check_env(
    env: BaseEnv, steps: int = 300, seed: int = 0, remake: Callable[[], BaseEnv] | None = None
) -> Report:
    """Play `steps` environment steps with random actions and check every record.

    `remake`: makes the same environment with the same seed again; then the same actions must give the
    same records. An environment with `get_state` and `set_state` must repeat itself after `set_state`.
    Leaves the environment open. Raises ContractError.
    """
    rng = np.random.default_rng(seed)
    report = Report()
    env.reset()
    _require(len(env.behavior_specs) > 0, "after reset() there is no behavior")
    for name, spec in env.behavior_specs.items():
        _check_spec(name, spec)
    _check_errors(env)
    _play(env, steps, rng, report, {})
    env.reset()
    _play(env, max(1, steps // 10), rng, report, {})
    report.checks += ["specs", "records", "errors", "reset"]
    if hasattr(env, "get_state") and hasattr(env, "set_state"):
        _check_snapshot(env, max(1, steps // 4), seed)
        report.checks.append("get_state/set_state")
    if remake is not None:
        _check_determinism(remake, max(1, steps // 4), seed)
        report.checks.append("seed")
    return report


def random_actions(
    name: str, spec: BehaviorSpec, decisions: DecisionSteps, rng: np.random.Generator
) -> ActionTuple:
    """Return random allowed actions of the agents in `decisions`: continuous U(-1, 1), masks obeyed.

    Raises ContractError: every action of a branch is forbidden (names the agent).
    """
    count = len(decisions)
    continuous = rng.uniform(-1, 1, (count, spec.action_spec.continuous_size)).astype(np.float32)
    discrete = np.zeros((count, spec.action_spec.discrete_size), np.int32)
    for branch, size in enumerate(spec.action_spec.discrete_branches):
        score = rng.random((count, size))
        if decisions.action_mask is not None:
            forbidden = decisions.action_mask[branch]
            for row in np.flatnonzero(forbidden.all(axis=1)):
                agent = int(decisions.agent_id[row])
                raise ContractError(f"{name}, agent {agent}: every action of branch {branch} is forbidden")
            score = np.where(forbidden, -1.0, score)
        discrete[:, branch] = score.argmax(axis=1)
    return ActionTuple(continuous, discrete)


def _play(
    env: BaseEnv, steps: int, rng: np.random.Generator, report: Report, agents: dict[int, _Agent]
) -> list[Any]:
    """Step with random actions, checking each result; return all records as flat arrays."""
    trace: list[Any] = []
    for _ in range(steps):
        num_decisions = num_terminals = 0
        asked: set[int] = set()
        records = {name: env.get_steps(name) for name in env.behavior_specs}
        for name, (_, terminals) in records.items():
            _check_terminals(name, env.behavior_specs[name], terminals, agents)
            num_terminals += len(terminals)
            report.interrupted += int(terminals.interrupted.sum())
            trace += _flat(terminals)
        for name, (decisions, _) in records.items():
            spec = env.behavior_specs[name]
            _check_decisions(name, spec, decisions, agents, asked)
            num_decisions += len(decisions)
            trace += _flat(decisions)
            if len(decisions):
                env.set_actions(name, random_actions(name, spec, decisions, rng))
        _require(num_decisions + num_terminals > 0, "step() returned without any record")
        report.steps += 1
        report.decisions += num_decisions
        report.terminals += num_terminals
        report.terminal_only_steps += num_decisions == 0
        env.step()
    return trace


def _check_spec(name: str, spec: BehaviorSpec) -> None:
    _require(len(spec.observation_specs) > 0, f"{name}: no observation")
    names = [sensor.name for sensor in spec.observation_specs]
    _require(len(set(names)) == len(names), f"{name}: sensor names repeat: {names}")
    for sensor in spec.observation_specs:
        good = all(isinstance(size, int) and size > 0 for size in sensor.shape)
        _require(good and len(sensor.shape) > 0, f"{name}, sensor {sensor.name}: shape {sensor.shape}")
        flags = len(sensor.dimension_property)
        _require(flags == len(sensor.shape), f"{name}, sensor {sensor.name}: {flags} dimension properties")
    actions = spec.action_spec
    _require(actions.continuous_size + actions.discrete_size > 0, f"{name}: no action")
    _require(all(size > 0 for size in actions.discrete_branches), f"{name}: branch of size 0")


def _check_records(name: str, spec: BehaviorSpec, steps: DecisionSteps | TerminalSteps) -> None:
    """Check shapes, dtypes and finite numbers of decision or terminal steps."""
    kind = type(steps).__name__
    count = len(steps.agent_id)
    _require(len(steps.obs) == len(spec.observation_specs), f"{name}: {kind} has {len(steps.obs)} sensors")
    for obs, sensor in zip(steps.obs, spec.observation_specs, strict=True):
        where = f"{name}, sensor {sensor.name}: {kind}"
        _require(
            obs.shape == (count, *sensor.shape), f"{where} shape {obs.shape}, not {(count, *sensor.shape)}"
        )
        _require(obs.dtype == np.float32, f"{where} dtype {obs.dtype}, not float32")
        _require_finite(name, steps.agent_id, obs, f"sensor {sensor.name}")
    for label, dtype in (("reward", np.float32), ("group_reward", np.float32), ("group_id", None)):
        values = getattr(steps, label)
        _require(values.shape == (count,), f"{name}: {kind} {label} shape {values.shape}, not {(count,)}")
        if dtype is not None:
            _require(values.dtype == dtype, f"{name}: {kind} {label} dtype {values.dtype}, not float32")
            _require_finite(name, steps.agent_id, values, label)
    for label in ("agent_id", "group_id"):
        values = getattr(steps, label)
        _require(np.issubdtype(values.dtype, np.integer), f"{name}: {kind} {label} dtype {values.dtype}")
    ids, counts = np.unique(steps.agent_id, return_counts=True)
    for agent in ids[counts > 1].tolist():
        raise ContractError(f"{name}, agent {agent}: twice in one {kind}")


def _check_terminals(name: str, spec: BehaviorSpec, steps: TerminalSteps, agents: dict[int, _Agent]) -> None:
    _check_records(name, spec, steps)
    _require(steps.interrupted.shape == (len(steps),), f"{name}: interrupted shape {steps.interrupted.shape}")
    _require(
        steps.interrupted.dtype == bool, f"{name}: interrupted dtype {steps.interrupted.dtype}, not bool"
    )
    for agent, group_id in zip(steps.agent_id.tolist(), steps.group_id.tolist(), strict=True):
        known = agents.get(agent)
        if known is None:
            agents[agent] = _Agent(name, group_id, ended=True)
            continue
        _require(not known.ended, f"{name}, agent {agent}: two terminal records without a decision between")
        _require(
            known.behavior == name,
            f"{name}, agent {agent}: ended here, but its last decision was in {known.behavior}",
        )
        _require(
            known.group_id == group_id,
            f"{name}, agent {agent}: ended in group {group_id}, but its decisions were in {known.group_id}",
        )
        known.ended = True


def _check_decisions(
    name: str, spec: BehaviorSpec, steps: DecisionSteps, agents: dict[int, _Agent], asked: set[int]
) -> None:
    _check_records(name, spec, steps)
    branches = spec.action_spec.discrete_branches
    if steps.action_mask is not None:
        shapes = [mask.shape for mask in steps.action_mask]
        wanted = [(len(steps), size) for size in branches]
        _require(shapes == wanted, f"{name}: action mask shapes {shapes}, not {wanted}")
        _require(all(mask.dtype == bool for mask in steps.action_mask), f"{name}: action mask is not bool")
    for agent, group_id in zip(steps.agent_id.tolist(), steps.group_id.tolist(), strict=True):
        _require(agent not in asked, f"{name}, agent {agent}: asks under two behaviors at once")
        asked.add(agent)
        known = agents.get(agent)
        if known is not None and not known.ended:
            _require(
                known.behavior == name,
                f"{name}, agent {agent}: came from {known.behavior} without a terminal record",
            )
        agents[agent] = _Agent(name, group_id)


def _check_errors(env: BaseEnv) -> None:
    """Check that wrong names, wrong shapes and agents that did not ask are refused."""
    name, spec = next(iter(env.behavior_specs.items()))
    decisions, _ = env.get_steps(name)
    missing = int(max(decisions.agent_id, default=0)) + 10_000
    wrong = spec.action_spec.empty_action(len(decisions) + 1)
    _require_raises(f"set_actions({name!r}) with a row too many", lambda: env.set_actions(name, wrong))
    one = spec.action_spec.empty_action(1)
    _require_raises(
        f"set_action_for_agent({name!r}, {missing}), which did not ask",
        lambda: env.set_action_for_agent(name, missing, one),
    )
    _require_raises("get_steps of an unknown behavior", lambda: env.get_steps("no such behavior"))
    if len(decisions):
        env.set_action_for_agent(name, int(decisions.agent_id[0]), one)


def _check_snapshot(env: Any, steps: int, seed: int) -> None:
    state = env.get_state()
    _check_plain(state, "get_state()")
    traces = []
    for _ in range(2):
        env.set_state(state)
        traces.append(_play(env, steps, np.random.default_rng(seed), Report(), {}))
    _require_equal(traces[0], traces[1], "after set_state() the same actions give other records")


def _check_determinism(remake: Callable[[], BaseEnv], steps: int, seed: int) -> None:
    traces = []
    for _ in range(2):
        env = remake()
        env.reset()
        traces.append(_play(env, steps, np.random.default_rng(seed), Report(), {}))
        env.close()
    _require_equal(traces[0], traces[1], "the same seed and actions give other records")


def _check_plain(value: Any, where: str) -> None:
    """Check that a snapshot holds nothing but dicts, lists, arrays and plain values."""
    if isinstance(value, dict):
        for key, item in value.items():
            _require(isinstance(key, str), f"{where} has a key {key!r} that is no string")
            _check_plain(item, f"{where}[{key!r}]")
    elif isinstance(value, list):
        for number, item in enumerate(value):
            _check_plain(item, f"{where}[{number}]")
    else:
        plain = type(value) in (int, float, str, bool, type(None)) or (
            isinstance(value, np.ndarray) and value.dtype != object
        )
        _require(plain, f"{where} is {type(value).__name__}, not an array or a plain value")


def _flat(steps: DecisionSteps | TerminalSteps) -> list[np.ndarray]:
    arrays = [steps.agent_id, steps.group_id, steps.reward, steps.group_reward, *steps.obs]
    return [np.array(array) for array in arrays] + (
        [np.array(steps.interrupted)] if isinstance(steps, TerminalSteps) else []
    )


def _require_equal(one: list[Any], other: list[Any], message: str) -> None:
    for number, (a, b) in enumerate(zip(one, other, strict=True)):
        _require(
            a.shape == b.shape and bool((a == b).all()), f"{message} (first at array {number} of the trace)"
        )


def _require_finite(name: str, agent_ids: np.ndarray, values: np.ndarray, what: str) -> None:
    if not np.isfinite(values).all():
        bad = ~np.isfinite(values.reshape(len(values), -1)).all(axis=1)
        raise ContractError(f"{name}, agent {int(agent_ids[np.flatnonzero(bad)[0]])}: {what} is not finite")


def _require_raises(what: str, call: Callable[[], Any]) -> None:
    try:
        call()
    except Exception:
        return
    raise ContractError(f"{what} is accepted, but must be refused")


def _require(holds: bool, message: str) -> None:
    if not holds:
        raise ContractError(message)


def main(arguments: list[str] | None = None) -> int:
    """Check an embedded scene from the command line; return 0 if it keeps the contract."""
    parser = argparse.ArgumentParser(prog="python -m mappo_unity.scenes.check", description=__doc__)
    parser.add_argument("scene", help=f"one of: {', '.join(scene_names())}")
    parser.add_argument("--steps", type=int, default=500)
    parser.add_argument("--num-areas", type=int, default=None)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)

    def make() -> BaseEnv:
        return make_scene(options.scene, seed=options.seed, num_areas=options.num_areas)

    try:
        report = check_env(make(), options.steps, options.seed, remake=make)
    except (ContractError, ConfigError) as error:
        print(f"{options.scene}: {error}", file=sys.stderr)
        return 1
    print(f"{options.scene}: {report}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
