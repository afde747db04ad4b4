"""A checked play: an environment with random actions, every record looked at.

The environment must have been reset. The check is stricter than the code that only reads records: types and
empty arrays must be right, too.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np
from mlagents_envs.base_env import ActionTuple, BehaviorSpec, DecisionSteps, TerminalSteps

from mappo_unity.scenes.contract.lifecycle import Lives, require
from mappo_unity.scenes.contract.records import RecordCheck, Repair
from mappo_unity.scenes.contract.rules import ContractError, check_same_specs

Trace: TypeAlias = "list[tuple[str, np.ndarray]]"  # what was sent: name and copy of each array


@dataclass
class Report:
    """Count what a checked run has seen."""

    steps: int = 0
    decisions: int = 0
    terminals: int = 0
    interrupted: int = 0
    terminal_only_steps: int = 0
    checks: list[str] = field(default_factory=list)


def play(env: Any, steps: int, rng: np.random.Generator, report: Report) -> Trace:
    """Step with random actions, checking each result; return all records."""
    trace: Trace = []
    lives = Lives()
    specs = dict(env.behavior_specs)
    checks = {name: RecordCheck(name, spec) for name, spec in specs.items()}

    for step in range(steps):
        num_decisions = num_terminals = 0
        check_same_specs(env.behavior_specs, specs)
        records = {name: _checked(checks[name], env.get_steps(name)) for name in specs}
        lives.begin_result()

        # All ends first: an agent may end and request again in one result.
        for name, (_, terminals) in records.items():
            lives.end(name, terminals)
            num_terminals += len(terminals)
            report.interrupted += int(terminals.interrupted.sum())
            trace += _arrays(f"step {step}, {name}", terminals)

        for name, (decisions, _) in records.items():
            lives.ask(name, decisions)
            num_decisions += len(decisions)
            trace += _arrays(f"step {step}, {name}", decisions)
            if len(decisions):
                env.set_actions(name, random_actions(name, specs[name], decisions, rng))

        require(
            num_decisions + num_terminals > 0,
            f"{'step' if step else 'reset'}() returned without any record: it must go on until some agent "
            "asks for a decision or ends",
        )

        report.steps += 1
        report.decisions += num_decisions
        report.terminals += num_terminals
        report.terminal_only_steps += num_decisions == 0

        env.step()

    return trace


def _checked(check: RecordCheck, result: Any) -> tuple[DecisionSteps, TerminalSteps]:
    """Check a result more strictly than its readers do: also the types, and the shapes of empty arrays."""
    check(result)

    for steps in result:
        # Only for what it refuses: what it converts is not used here.
        Repair(check.name, check.spec, steps).converted()
        kind = "DecisionSteps" if isinstance(steps, DecisionSteps) else "TerminalSteps"
        for label, values in _arrays("", steps):
            wanted = _wanted_type(label)
            require(
                wanted is None or values.dtype == wanted,
                f"{check.name}: {kind} {label.split()[-1]} dtype {values.dtype}, not {wanted}",
            )

        for mask in getattr(steps, "action_mask", None) or []:
            require(mask.dtype == bool, f"{check.name}: action mask dtype {mask.dtype}, not bool")

    return result[0], result[1]


def _wanted_type(label: str) -> str | None:
    name = label.split()[-1]
    return None if name in ("agent_id", "group_id") else "bool" if name == "interrupted" else "float32"


def _arrays(where: str, steps: DecisionSteps | TerminalSteps) -> Trace:
    """Return copies of all arrays of decision or terminal steps but the masks, with their names."""
    kind = "decision" if isinstance(steps, DecisionSteps) else "terminal"
    columns = ["agent_id", "group_id", "reward", "group_reward"]
    columns += [] if isinstance(steps, DecisionSteps) else ["interrupted"]
    named = [(column, getattr(steps, column)) for column in columns]
    named += [(f"obs_{index}", obs) for index, obs in enumerate(steps.obs)]
    return [(f"{where}: {kind} {name}", np.array(array)) for name, array in named]


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
            # Below the score of every allowed action.
            score = np.where(forbidden, -1.0, score)
        discrete[:, branch] = score.argmax(axis=1)

    return ActionTuple(continuous, discrete)
