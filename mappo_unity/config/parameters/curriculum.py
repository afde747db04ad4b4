"""A curriculum: lessons of an environment parameter, one after another, and what completes each.

Keys and defaults are ML-Agents' (trainers/settings.py, CompletionCriteriaSettings) in shorter words; its own
are read too.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from mappo_unity.config.option_table import show_value
from mappo_unity.config.parameters.samplers import Value, check_keys, read_number, read_value, respelled
from mappo_unity.errors import ConfigError

LESSONS = "lessons"
PROGRESS, REWARD, GROUP_REWARD = "progress", "reward", "group_reward"
MEASURES = PROGRESS, REWARD, GROUP_REWARD  # ML-Agents has the first two

_SPELLINGS = {"curriculum": LESSONS, "completion_criteria": "completion"}
_LESSON_KEYS = ("name", "value", "completion")
_COMPLETION_KEYS = (
    *("behavior", "measure", "threshold"),
    *("min_lesson_length", "signal_smoothing", "require_reset"),
)
_EXAMPLE = "{measure: progress, threshold: 0.1}"


@dataclass(frozen=True)
class Completion:
    """When a lesson is complete."""

    behavior: str | None
    """Policy name whose episodes count; None: the only one there is."""
    measure: str
    """PROGRESS: the share of the run's max_steps that is done; REWARD: the mean return of new episodes, what
    agents earn by themselves; GROUP_REWARD: what they earn as a group."""
    threshold: float
    """What the measure must be above."""
    min_lesson_length: int
    """Episodes that must have ended in the lesson."""
    signal_smoothing: bool
    """Let three quarters of a mean return count, and a quarter of the smoothed one before it."""
    require_reset: bool
    """Reset the whole environment when the lesson is complete."""


@dataclass(frozen=True)
class Lesson:
    """A value, in force until its completion; the last lesson has none that counts."""

    name: str
    value: Value
    completion: Completion | None


@dataclass(frozen=True)
class Curriculum:
    """The lessons of a parameter, at least one."""

    lessons: tuple[Lesson, ...]


def is_curriculum(raw: Any) -> bool:
    """Return whether an option's value is meant as a curriculum."""
    return isinstance(raw, dict) and any(_SPELLINGS.get(str(key), key) == LESSONS for key in raw)


def read_curriculum(where: str, raw: dict[Any, Any]) -> Curriculum:
    """Return a curriculum as its option writes it.

    Raises:
        ConfigError: something in it is wrong; begins with `where`.
    """
    raw = respelled(raw, _SPELLINGS)
    check_keys(where, raw, [LESSONS])

    lessons = raw[LESSONS]
    if not isinstance(lessons, list) or not lessons:
        raise ConfigError(
            f"{where}.lessons={show_value(lessons)} must be a list of at least one lesson, for example "
            f"[{{value: 1, completion: {_EXAMPLE}}}, {{value: 2}}]"
        )

    last = len(lessons) - 1
    return Curriculum(
        tuple(
            _lesson(f"{where}.lessons[{number}]", number, item, number == last)
            for number, item in enumerate(lessons)
        )
    )


def _lesson(where: str, number: int, raw: Any, is_last: bool) -> Lesson:
    if not isinstance(raw, dict):
        raise ConfigError(f"{where}={show_value(raw)} must be a lesson, for example {{value: 1}}")
    raw = respelled(raw, _SPELLINGS)
    check_keys(where, raw, _LESSON_KEYS)

    if "value" not in raw:
        raise ConfigError(f"{where} has no value: give value: NUMBER, or a sampler")
    value = read_value(f"{where}.value", raw["value"])

    completion = raw.get("completion")
    if completion is None:
        if not is_last:
            raise ConfigError(
                f"{where} has no completion, which every lesson but the last needs, for example "
                f"completion: {_EXAMPLE}"
            )
        return Lesson(_name(where, number, raw), value, None)
    return Lesson(_name(where, number, raw), value, _completion(f"{where}.completion", completion))


def _name(where: str, number: int, raw: dict[Any, Any]) -> str:
    name = raw.get("name", f"Lesson{number}")
    if isinstance(name, bool) or not isinstance(name, (str, int)) or name == "":
        raise ConfigError(f"{where}.name={show_value(name)} must be a text")
    return str(name)


def _completion(where: str, raw: Any) -> Completion:
    if not isinstance(raw, dict):
        raise ConfigError(f"{where}={show_value(raw)} must be named values, for example {_EXAMPLE}")
    check_keys(where, raw, _COMPLETION_KEYS)

    behavior = raw.get("behavior")
    if behavior is not None and (not isinstance(behavior, (str, int)) or isinstance(behavior, bool)):
        raise ConfigError(f"{where}.behavior={show_value(behavior)} must be a behavior's name")

    measure = raw.get("measure", REWARD)
    if measure not in MEASURES:
        raise ConfigError(
            f"{where}.measure={show_value(measure)} does not exist; choices: {', '.join(MEASURES)}"
        )

    threshold = read_number(f"{where}.threshold", raw.get("threshold", 0.0))
    if measure == PROGRESS and not 0 <= threshold <= 1:
        raise ConfigError(
            f"{where}.threshold={threshold:g} is out of range: with measure: progress, the share of the "
            "run's steps that are done, it must be from 0 to 1"
        )

    length = raw.get("min_lesson_length", 0)
    if isinstance(length, bool) or not isinstance(length, int) or length < 0:
        raise ConfigError(f"{where}.min_lesson_length={show_value(length)} must be a whole number >= 0")

    return Completion(
        None if behavior is None else str(behavior),
        measure,
        threshold,
        length,
        _flag(where, raw, "signal_smoothing", True),
        _flag(where, raw, "require_reset", False),
    )


def _flag(where: str, raw: dict[Any, Any], key: str, default: bool) -> bool:
    value = raw.get(key, default)
    if not isinstance(value, bool):
        raise ConfigError(f"{where}.{key}={show_value(value)} must be true or false")
    return value
