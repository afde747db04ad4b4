"""A user's environment, whose errors are told as the user's.

In: a BaseEnv made by env.factory. Out: the same, but whatever it raises ends the run as an
`EnvironmentFailure` with the user's frames of the traceback. Knows nothing of options.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

from mlagents_envs.base_env import ActionTuple, BaseEnv, BehaviorMapping, DecisionSteps, TerminalSteps

from mappo_unity.config.schema import ConfigError, EnvironmentFailure

Result = TypeVar("Result")


class GuardedEnv(BaseEnv):
    """Hand every call on; what BaseEnv does not have (``get_state`` ...) is the wrapped environment's own.

    Args:
        env: the user's environment.
        name: what messages call it.
        explain: exception and beginning of a message to an error with the user's frames in its `details`.
    """

    def __init__(self, env: BaseEnv, name: str, explain: Callable[[BaseException, str], ConfigError]) -> None:
        self._env, self._name, self._explain = env, name, explain

    def __getattr__(self, attribute: str) -> Any:
        return getattr(self._env, attribute)

    @property
    def behavior_specs(self) -> BehaviorMapping:
        """The environment's behaviors."""
        return self._call("behavior_specs", lambda: self._env.behavior_specs)

    def step(self) -> None:
        """Step the environment."""
        self._call("step", self._env.step)

    def reset(self) -> None:
        """Reset the environment."""
        self._call("reset", self._env.reset)

    def close(self) -> None:
        """Close the environment."""
        self._call("close", self._env.close)

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
            failure = EnvironmentFailure(str(mistake))
            failure.details = mistake.details
            raise failure from error
