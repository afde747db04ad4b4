"""ML-Agents' settings with all their defaults, as its configuration.yaml has them."""

from __future__ import annotations

from typing import Any

from mappo_unity.config.mlagents.behavior import nested, team_change
from mappo_unity.config.mlagents.keys import OPTIONAL, RUN, SIGNALS
from mappo_unity.config.mlagents.settings import Section, Settings


def resolved(settings: Settings) -> dict[str, Any]:
    """Return every value in force, nested; sections that are off are null."""
    out: dict[str, Any] = {"default_settings": None}
    if settings.default is not None:
        out["default_settings"] = _nested(settings.default, _in_force(settings.default))
    out["behaviors"] = {name: _nested(s, _in_force(s)) for name, s in settings.behaviors.items()}
    out |= _nested(settings.run, list(RUN))
    out["environment_parameters"] = {name: given.value for name, given in settings.parameters.items()} or None
    return out


def _in_force(section: Section) -> list[str]:
    signals = [name for name in SIGNALS if section.has(f"reward_signals.{name}")]
    if not section.has("reward_signals"):
        signals = ["extrinsic"]
    absent = [name for name in OPTIONAL if not section.has(name)]
    absent += [f"reward_signals.{name}" for name in SIGNALS if name not in signals]
    keys = [key for key in section.table if not key.startswith(tuple(f"{name}." for name in absent))]
    return keys + [name for name in absent if name in OPTIONAL and not name.startswith("reward_signals.")]


def _nested(section: Section, keys: list[str]) -> dict[str, Any]:
    return nested({key: _value(section, key) for key in keys})


def _value(section: Section, key: str) -> Any:
    if key == "self_play.team_change":  # whose default follows from another key
        return team_change(section)
    return section[key] if key in section.table else None
