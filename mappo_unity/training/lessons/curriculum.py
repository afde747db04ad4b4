"""Lessons of a run: which is in force for each parameter with a curriculum, and when the next one is due.

As ML-Agents' EnvironmentParameterManager (trainers/environment_parameter_manager.py), with one difference:
lessons are looked at once an iteration, and a return is smoothed only where new episodes have ended since.
ML-Agents looks after every step of the environment, and smooths the same episodes again each time.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from mappo_unity import keys
from mappo_unity.config.parameters.curriculum import GROUP_REWARD, PROGRESS, REWARD, Completion, Lesson
from mappo_unity.config.parameters.samplers import Sampler, Value
from mappo_unity.config.parameters.values import curricula, show_parameter, values_at
from mappo_unity.config.schema import Backend, EnvConfig
from mappo_unity.envs.returns import Episode
from mappo_unity.errors import ConfigError
from mappo_unity.training.collection.description import Played

KEPT = 0.25
"""Share of the smoothed return before in the new one (CompletionCriteriaSettings.need_increment)."""


@dataclass(frozen=True)
class Change:
    """A parameter that goes on to another lesson."""

    name: str
    number: int
    count: int
    lesson: Lesson
    require_reset: bool

    def __str__(self) -> str:
        return (
            f"env.params.{self.name}: lesson {self.number} of 0-{self.count - 1} ({self.lesson.name}): "
            f"{show_parameter(self.lesson.value)}"
        )


class Lessons:
    """The lessons in force, and what the next ones wait for.

    Args:
        parameters: of the environment, as `EnvConfig.parameters` returns them.
        team_sizes: of every policy name, agents of its largest team.
        sets_numbers: plain numbers are parameters that can be set, not what an environment was made with.

    Attributes: `numbers`, lesson of each parameter with a curriculum, from 0; `notes`, lines for the user.

    Raises:
        ConfigError: a lesson waits for a behavior that there is not.
    """

    def __init__(
        self, parameters: Mapping[str, Any], team_sizes: Mapping[str, int], sets_numbers: bool = False
    ) -> None:
        self._parameters, self._curricula = parameters, curricula(parameters)
        self._sets_numbers = sets_numbers
        self._check_behaviors(list(team_sizes))

        self.numbers = dict.fromkeys(self._curricula, 0)
        self.notes = list(self._make_notes(team_sizes))
        self._smoothed = dict.fromkeys(self._curricula, 0.0)
        self._windows = {measure: self._make_windows(team_sizes) for measure in (REWARD, GROUP_REWARD)}

    @property
    def are_last(self) -> bool:
        """Whether every curriculum is at its last lesson."""
        return all(number == self._last(name) for name, number in self.numbers.items())

    @property
    def values(self) -> dict[str, Any]:
        """The values of all parameters that are in force."""
        return values_at(self._parameters, self.numbers)

    def in_force(self) -> dict[str, Value]:
        """Return the values of the parameters with a curriculum."""
        values = self.values
        return {name: values[name] for name in self.numbers}

    def metrics(self) -> dict[str, float]:
        """Return the numbers of the lessons in force as metrics."""
        return {f"lesson/{name}": float(number) for name, number in self.numbers.items()}

    def advance(self, episodes: Mapping[str, list[Episode]], progress: float) -> list[Change]:
        """Take finished episodes in; return the parameters that go on to their next lesson.

        Args:
            episodes: those that finished in an iteration, by full behavior name.
            progress: share of the run's steps that are done.
        """
        with_news = set()
        for behavior, finished in episodes.items():
            policy = keys.policy_name(behavior)
            # an episode without a decision says nothing
            counted = [episode for episode in finished if episode.length]
            self._windows[REWARD][policy].extend(episode.individual_return for episode in counted)
            self._windows[GROUP_REWARD][policy].extend(episode.group_return for episode in counted)
            if counted:
                with_news.add(policy)

        changes = [self._next(name) for name in self.numbers if self._is_complete(name, progress, with_news)]
        for change in changes:
            self.numbers[change.name] = change.number
        if changes:  # the episodes of other conditions say nothing about the new ones
            for windows in self._windows.values():
                for window in windows.values():
                    window.clear()
        return changes

    def state_dict(self) -> dict[str, Any]:
        """Return everything that resuming needs."""
        return {
            "numbers": dict(self.numbers),
            "smoothed": dict(self._smoothed),
            "returns": _listed(self._windows[REWARD]),
            "group_returns": _listed(self._windows[GROUP_REWARD]),
            "are_last": self.are_last,
            "values": self._shown(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> dict[str, Value]:
        """Restore what `state_dict` returned, or nothing (older checkpoints).

        Returns:
            What can be set and differs from what was in force when the state was taken, as options were
            changed since; of older states, which hold no plain numbers, all of these.
        """
        for name, number in state.get("numbers", {}).items():
            if name in self.numbers:
                self.numbers[name] = min(number, self._last(name))
                self._smoothed[name] = state["smoothed"][name]
        for measure, entry in ((REWARD, "returns"), (GROUP_REWARD, "group_returns")):
            for policy, returns in state.get(entry, {}).items():
                if policy in self._windows[measure]:
                    self._windows[measure][policy].extend(returns)

        before, now = state.get("values", {}), self._shown()
        changed = [name for name in self._parameters if before.get(name) != now.get(name)]
        return {name: self.values[name] for name in changed}

    def _shown(self) -> dict[str, str]:
        """Return the values in force of parameters that can be set, for reading."""
        shown = {}
        for name, value in self.values.items():
            if name in self._curricula or isinstance(value, Sampler):
                shown[name] = show_parameter(value)
            elif self._sets_numbers:
                shown[name] = str(value)
        return shown

    def _is_complete(self, name: str, progress: float, with_news: set[str]) -> bool:
        completion = self._curricula[name].lessons[self.numbers[name]].completion
        if self.numbers[name] == self._last(name) or completion is None:
            return False

        policy, measured = self._policy(completion), completion.measure
        window = self._windows[REWARD if measured == PROGRESS else measured][policy]
        if len(window) < completion.min_lesson_length:
            return False
        if measured == PROGRESS:
            return progress > completion.threshold

        if policy not in with_news:
            return False
        measure = float(np.mean(window))
        if completion.signal_smoothing:
            measure = self._smoothed[name] = KEPT * self._smoothed[name] + (1 - KEPT) * measure
        return measure > completion.threshold

    def _next(self, name: str) -> Change:
        lessons, number = self._curricula[name].lessons, self.numbers[name]
        completion = lessons[number].completion
        assert completion is not None
        return Change(name, number + 1, len(lessons), lessons[number + 1], completion.require_reset)

    def _last(self, name: str) -> int:
        return len(self._curricula[name].lessons) - 1

    def _policy(self, completion: Completion) -> str:
        return completion.behavior or next(iter(self._windows[REWARD]))

    def _completions(self) -> Iterable[tuple[str, Completion]]:
        """Yield every completion with the option that says it."""
        for name, curriculum in self._curricula.items():
            for number, lesson in enumerate(curriculum.lessons):
                if lesson.completion is not None:
                    yield f"env.params.{name}.lessons[{number}].completion", lesson.completion

    def _make_windows(self, policies: Iterable[str]) -> dict[str, deque[float]]:
        return {policy: deque(maxlen=self._window(policy)) for policy in policies}

    def _window(self, policy: str) -> int:
        """Return how many returns of a policy are kept: what its most demanding lesson asks for."""
        own = [item for _, item in self._completions() if item.behavior in (None, policy)]
        return max([1, *(item.min_lesson_length for item in own)])

    def _check_behaviors(self, policies: list[str]) -> None:
        for where, completion in self._completions():
            if completion.behavior is None and len(policies) > 1:
                raise ConfigError(
                    f"{where} names no behavior, but there are several: give behavior: one of "
                    f"{', '.join(policies)}"
                )
            if completion.behavior not in (None, *policies):
                raise ConfigError(
                    f"{where}.behavior={completion.behavior}: the environment has no such behavior; it has "
                    f"{', '.join(policies)}"
                )

    def _make_notes(self, team_sizes: Mapping[str, int]) -> Iterable[str]:
        for name, curriculum in self._curricula.items():
            if curriculum.lessons[-1].completion is not None:
                yield f"note: env.params.{name}: the completion of its last lesson has no effect"

        for where, completion in self._completions():
            policy = completion.behavior or next(iter(team_sizes))
            if completion.measure == REWARD and team_sizes[policy] > 1:
                yield (
                    f"note: {where} measures the individual rewards of {policy}, as ML-Agents does; what its "
                    f"agents earn as a group does not count (measure: {GROUP_REWARD})"
                )
            if completion.measure == GROUP_REWARD and team_sizes[policy] == 1:
                yield f"note: {where} measures what {policy} earns as a group, but its agents are alone"


def _listed(windows: Mapping[str, deque[float]]) -> dict[str, list[float]]:
    return {policy: list(window) for policy, window in windows.items()}


def lessons_of(cfg: EnvConfig, env: Played) -> Lessons:
    """Return the lessons of the options; raise ConfigError where the environment does not fit them."""
    sizes = {name: env.behaviors[sides[0]].slots.team_size for name, sides in env.sides.items()}
    is_made = cfg.backend in (Backend.custom, Backend.pettingzoo)  # with the parameters as arguments
    parameters = cfg.parameters
    if cfg.backend is Backend.embedded:
        # a scene is made with its threads, and has no such parameter
        parameters.pop("num_threads", None)

    lessons = Lessons(parameters, sizes, sets_numbers=not is_made)
    if lessons.numbers and not env.takes_parameters:
        raise ConfigError(
            f"env.params.{next(iter(lessons.numbers))} has lessons, but the environment's parameters cannot "
            "be set while it plays: it needs a method set_parameter(name, value)"
        )
    return lessons
