"""An environment of any backend, opened for a seed, and opened anew for another."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from mlagents_envs.base_env import ActionTuple, BaseEnv, BehaviorSpec, DecisionSteps, TerminalSteps

from mappo_unity.config.compose import compose_config
from mappo_unity.config.parameters.values import params_at
from mappo_unity.config.renamed import rename_lines
from mappo_unity.config.schema import Backend, Config
from mappo_unity.config.text_lines import literal_lines
from mappo_unity.envs.backends import MakeEnv, make_env_function
from mappo_unity.envs.opening import First, first_results
from mappo_unity.errors import ConfigError
from mappo_unity.scenes.contract.rules import MAX_SILENT_STEPS, check_same_specs
from mappo_unity.scenes.contract.statistics import pop_statistics


class Session:
    """Step a BaseEnv; begin it anew.

    Args:
        env: a preset's name, or an open environment.
        options: further options.
        seed: it is opened with.
        num_areas: env.num_areas; None: the preset's.

    Attributes:
        name: what messages call it; first: its behaviors as they showed at first.
    """

    def __init__(self, env: str | BaseEnv, options: Sequence[str], seed: int, num_areas: int | None) -> None:
        self._make: MakeEnv | None = None
        self._seed = seed
        self.first: Mapping[str, First] = {}

        if isinstance(env, str):
            # as a command line goes: today's names first, then texts as they were typed
            lines = literal_lines(rename_lines(list(options)), Config, False)
            cfg = compose_config([f"env={env}", *lines]).config.env
            is_given = any(line.startswith("env.num_areas=") for line in lines)
            if num_areas is not None and not is_given and cfg.backend is not Backend.custom:
                cfg.num_areas = num_areas
            cfg.params = params_at(cfg.params, {}, missing=-1)  # whoever trains elsewhere has no lessons
            self.name = cfg.name
            self._make = make_env_function(cfg)
            self._env = self._make(seed)
        else:
            if options:
                raise ConfigError(
                    f"{options[0]}: options are for a preset's name, not for an open environment"
                )
            self.name, self._env = type(env).__name__, env

        self._is_fresh = False
        try:
            self.first = self._reset()
        except BaseException:
            if self._make is not None:  # nobody else could end a player that was started here
                self._env.close()
            raise
        self._is_fresh = True

    def begin(self, seed: int | None) -> Mapping[str, First]:
        """Begin anew everywhere; return the first records by behavior.

        Raises:
            ConfigError: a seed is given, but the environment came open and cannot be opened for it.
            EnvironmentDataError: a behavior has changed, or is new.
        """
        if seed is not None and not (self._is_fresh and seed == self._seed):
            if self._make is None:
                raise ConfigError(
                    f"seed={seed}: {self.name} came open and keeps its own seed; give a preset's name instead"
                )
            self._env.close()
            self._seed, self._env = seed, self._make(seed)
            return self._reset()

        first = self.first if self._is_fresh else self._reset()
        self._is_fresh = False
        return first

    def step(self, actions: Mapping[str, ActionTuple]) -> dict[str, tuple[DecisionSteps, TerminalSteps]]:
        """Step once with an action of every behavior some of whose agents requested a decision."""
        self._is_fresh = False
        for behavior, action in actions.items():
            self._env.set_actions(behavior, action)
        self._env.step()
        if self._make is not None:  # nobody else can read them here, and a player's would pile up
            pop_statistics(self._env)

        check_same_specs(self._env.behavior_specs, self._first_specs())
        return {name: first.check(self._env.get_steps(name)) for name, first in self.first.items()}

    def close(self) -> None:
        """Close the environment."""
        self._env.close()

    def _reset(self) -> Mapping[str, First]:
        self._env.reset()
        self._is_fresh = False
        found = first_results(self._env, MAX_SILENT_STEPS)

        known = self._first_specs()
        if known:
            # a player that was opened anew shows a behavior only with its first agents
            check_same_specs({**known, **self._env.behavior_specs}, known)
        return found

    def _first_specs(self) -> dict[str, BehaviorSpec]:
        return {name: first.spec for name, first in self.first.items()}
