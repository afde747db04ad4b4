"""What an environment shows at first: its behaviors, and how many teams and agents they have."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from mlagents_envs.base_env import BaseEnv, BehaviorSpec, DecisionSteps, TerminalSteps

from mappo_unity import keys
from mappo_unity.envs.slots import count_teams
from mappo_unity.scenes.contract.records import RecordCheck
from mappo_unity.scenes.contract.rules import EnvironmentDataError, check_specs, note_silence


class First(NamedTuple):
    """A behavior as it first showed."""

    check: RecordCheck  # of its further results
    decision: DecisionSteps
    terminal: TerminalSteps

    @property
    def spec(self) -> BehaviorSpec:
        """Its sensors and actions."""
        return self.check.spec


def first_results(env: BaseEnv, max_steps: int) -> dict[str, First]:
    """Step an environment until an agent requests a decision; return its behaviors by name.

    Raises:
        EnvironmentDataError: no agent requests a decision within `max_steps`, or what it shows breaks the
            contract.
    """
    for attempt in range(max_steps):
        # anew after each step: a player shows a behavior only with its first agents
        check_specs(env.behavior_specs)
        behaviors = {}
        for name, spec in env.behavior_specs.items():
            check = RecordCheck(name, spec)
            behaviors[name] = First(check, *check(env.get_steps(name)))

        if any(len(first.decision) for first in behaviors.values()):
            return behaviors

        note_silence(attempt, max_steps)
        env.step()

    what = (
        f"get_steps gave no DecisionSteps of {list(behaviors)}"
        if behaviors
        else "behavior_specs stayed empty"
    )
    raise EnvironmentDataError(
        f"the environment shows no behavior with an agent that requests a decision: {what} in {max_steps} "
        "steps after reset()"
    )


def team_sizes(behaviors: Mapping[str, First]) -> dict[str, tuple[int, int]]:
    """Return of every behavior how many teams it has and the largest one's members: the most of any side."""
    sizes: dict[str, tuple[int, int]] = {}

    for name, first in behaviors.items():
        teams, members = count_teams(first.decision.agent_id, first.decision.group_id)
        # sides of one policy are stacked, so they get equally many slots
        seen = sizes.get(keys.policy_name(name), (1, 1))
        sizes[keys.policy_name(name)] = max(seen[0], teams), max(seen[1], members)

    return {name: sizes[keys.policy_name(name)] for name in behaviors}
