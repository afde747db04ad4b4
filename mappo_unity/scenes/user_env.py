"""A user's environment, whose errors are reported as the user's.

It wraps a BaseEnv made by env.factory: whatever that raises ends the run as a `ConfigError` (before its first
step) or an `EnvironmentFailure`, with the user's frames of the traceback. A `close` that raises is only
noted, because what was done before stands.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any, TypeVar

from mlagents_envs.base_env import ActionTuple, BaseEnv, BehaviorMapping, DecisionSteps, TerminalSteps

from mappo_unity.errors import ConfigError, EnvironmentFailure

Result = TypeVar("Result")

logger = logging.getLogger(__name__)


class GuardedEnv(BaseEnv):
    """Hand every call on; what BaseEnv does not have (``get_state`` ...) is the wrapped environment's own.

    Args:
        env: the user's environment.
        name: what messages call it.
        explain: exception and beginning of a message to an error with the user's frames in its `details`.
    """

    def __init__(self, env: BaseEnv, name: str, explain: Callable[[BaseException, str], ConfigError]) -> None:
        self._env, self._name, self._explain = env, name, explain
        self._has_stepped = False

    def __getattr__(self, attribute: str) -> Any:
        if attribute == "_env":  # not there yet, in a copy that is being made
            raise AttributeError(attribute)

        # Not methods of this class: hasattr must say what the user's environment has.
        value = getattr(self._env, attribute)
        if attribute in ("get_state", "set_state", "set_parameter", "pop_statistics"):
            return lambda *arguments: self._call(attribute, value, *arguments)

        return value

    @property
    def behavior_specs(self) -> BehaviorMapping:
        """The environment's behaviors."""
        return self._call("behavior_specs", lambda: self._env.behavior_specs)

    def step(self) -> None:
        """Step the environment."""
        # Before the call: what the first step raises is a failure, not a mistake in the options.
        self._has_stepped = True
        self._call("step", self._env.step)

    def reset(self) -> None:
        """Reset the environment."""
        self._call("reset", self._env.reset)

    def close(self) -> None:
        """Close the environment; log a warning if it cannot be closed."""
        try:
            self._env.close()
        except (Exception, SystemExit) as error:
            mistake = self._explain(error, f"{self._name}: its close")
            logger.warning("%s", "\n".join([f"{mistake}; what was done before stands", *mistake.details]))

    def set_actions(self, behavior_name: str, action: ActionTuple) -> None:
        """Hand the actions of a behavior's agents on."""
        self._call("set_actions", self._env.set_actions, behavior_name, action)

    def set_action_for_agent(self, behavior_name: str, agent_id: int, action: ActionTuple) -> None:
        """Hand one agent's action on."""
        self._call("set_action_for_agent", self._env.set_action_for_agent, behavior_name, agent_id, action)

    def get_steps(self, behavior_name: str) -> tuple[DecisionSteps, TerminalSteps]:
        """Return a behavior's records."""
        return self._call("get_steps", self._env.get_steps, behavior_name)

    def _call(self, method: str, call: Callable[..., Result], *arguments: Any) -> Result:
        try:
            return call(*arguments)
        except (ConfigError, EnvironmentFailure):
            raise
        except (Exception, SystemExit) as error:
            mistake = self._explain(error, f"{self._name}: its {method}")
            if not self._has_stepped:
                raise mistake from error

            failure = EnvironmentFailure(str(mistake))
            failure.details = mistake.details
            raise failure from error
