"""ML-Agents' configuration, checked and merged: the file, default_settings below each behavior, flags on top."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mappo_unity.config.mlagents.flags import Flags, flag_of
from mappo_unity.config.mlagents.keys import (
    BEHAVIOR,
    FLAG,
    NUMBER,
    OPTIONAL,
    RENAMED,
    RUN,
    TEXT,
    TOP,
    WHOLE,
    Key,
)
from mappo_unity.config.mlagents.yaml_lines import Node, read_yaml
from mappo_unity.config.option_table import did_you_mean, show_value
from mappo_unity.errors import ConfigError

_SPREAD = ("beta_schedule", "epsilon_schedule")


@dataclass(frozen=True)
class Given:
    """A value that somebody gave, and where: ``my.yaml, line 5: behaviors.Ball.max_steps``."""

    value: Any
    where: str


@dataclass
class Section:
    """Dotted keys that are given, above the defaults of a table."""

    table: Mapping[str, Key]
    given: dict[str, Given] = field(default_factory=dict)

    def __getitem__(self, key: str) -> Any:
        return self.given[key].value if key in self.given else self.table[key].default

    def has(self, prefix: str) -> bool:
        """Return whether a section, or anything in it, is given and not null."""
        if prefix in self.given:
            return self.given[prefix].value is not None
        return any(key.startswith(f"{prefix}.") for key in self.given)

    def where(self, key: str) -> str:
        """Return where a key is given, or its name."""
        return self.given[key].where if key in self.given else key


@dataclass
class Settings:
    """A whole configuration; `behaviors` are merged with default_settings."""

    behaviors: dict[str, Section]
    default: Section | None
    """What behaviors have that the file does not name; None: there may be none."""
    run: Section
    parameters: dict[str, Given]
    """As the file has them, by name."""
    warnings: list[str]


def read_settings(flags: Flags) -> Settings:
    """Read the file that a command line names, and put its flags on top; raise ConfigError."""
    if flags.config is None:
        tree, reader = Node({}, 1), _Reader("")
    else:
        tree, reader = read_yaml(Path(flags.config)), _Reader(f"{flags.config}, line ")

    for name, node in tree.value.items():
        if name not in TOP:
            raise ConfigError(reader.unknown_section(name, node))

    default = reader.default(tree)
    sections = {name: reader.behavior(name, node, default) for name, node in reader.behaviors(tree)}
    if not sections and default is None:
        # without a file ML-Agents takes its defaults for whatever is there
        if flags.config is not None:
            raise ConfigError(f"{flags.config} names no behavior: give behaviors: or default_settings:")
        default = Section(BEHAVIOR)

    run = reader.run(tree)
    for key, value in flags.given.items():
        run.given[key] = Given(checked(value, RUN[key], flag_of(key)), flag_of(key))

    return Settings(sections, default, run, reader.parameters(tree), flags.warnings + reader.warnings)


def checked(value: Any, key: Key, where: str) -> Any:
    """Return a key's value in its type; raise ConfigError, which begins with `where`."""
    if value is None and key.optional:
        return None

    if key.kind == FLAG:
        fits = isinstance(value, bool)
    elif key.kind in (WHOLE, NUMBER):
        number = _number(value)
        fits = number is not None and (key.kind == NUMBER or number.is_integer())
        value = number if number is None or key.kind == NUMBER else int(number)
    elif key.kind == TEXT:
        fits = isinstance(value, (str, int, float)) and not isinstance(value, bool)
        value = str(value)
    else:
        value = value.split() if isinstance(value, str) else value
        fits = isinstance(value, list)
        value = [str(item) for item in value] if fits else value

    if not fits:
        raise ConfigError(f"{where} must be {key.kind}, and is {_shown(value)}")
    if key.choices and value not in key.choices:
        hint = did_you_mean(value, key.choices)
        raise ConfigError(f"{where}: {value} does not exist{hint}; choices: {', '.join(key.choices)}")
    return value


class _Reader:
    """Reads sections of one file; `before` stands in front of a line's number."""

    def __init__(self, before: str) -> None:
        self._before = before
        self.warnings: list[str] = []

    def place(self, node: Node, key: str) -> str:
        return f"{self._before}{node.line}: {key}"

    def unknown_section(self, name: str, node: Node) -> str:
        inside = node.value if isinstance(node.value, dict) else {}
        if name == "default" or {"trainer", "trainer_type", "batch_size", "hyperparameters"} & {*inside}:
            return (
                f"{self.place(node, name)}: this is the format before ML-Agents Release 3: behaviors stand "
                "below behaviors: now, and what default: held below default_settings:"
            )
        hint = did_you_mean(name, TOP)
        return f"{self.place(node, name)} is no section of ML-Agents{hint}; sections: {', '.join(TOP)}"

    def default(self, tree: Node) -> Section | None:
        node = tree.value.get("default_settings")
        if node is None or node.value is None:
            return None
        own = self._flat(node, "default_settings")
        # expanded before behaviors come on top: their learning_rate_schedule does not spread any more
        rate = own.get("hyperparameters.learning_rate_schedule")
        for name in _SPREAD:
            value = Given("linear", "default_settings") if rate is None else rate
            own.setdefault(f"hyperparameters.{name}", value)
        return Section(BEHAVIOR, own)

    def behaviors(self, tree: Node) -> Iterator[tuple[str, Node]]:
        node = tree.value.get("behaviors")
        if node is None:
            return
        if not isinstance(node.value, dict) or not node.value:
            raise ConfigError(f"{self.place(node, 'behaviors')} must hold behaviors by name")
        yield from node.value.items()

    def behavior(self, name: str, node: Node, default: Section | None) -> Section:
        own = self._flat(node, f"behaviors.{name}", default)
        section = Section(BEHAVIOR, _merged({} if default is None else default.given, own))

        rate = own.get("hyperparameters.learning_rate_schedule")
        for key in _SPREAD:
            if rate is not None and f"hyperparameters.{key}" not in section.given:
                section.given[f"hyperparameters.{key}"] = rate
        return section

    def run(self, tree: Node) -> Section:
        section = Section(RUN)
        for name in dict.fromkeys(key.partition(".")[0] for key in RUN):
            node = tree.value.get(name)
            if node is not None and name in RUN:
                section.given[name] = Given(
                    checked(node.plain, RUN[name], self.place(node, name)), self.place(node, name)
                )
            elif node is not None:
                self._take(node, name, name, RUN, section.given)
        return section

    def parameters(self, tree: Node) -> dict[str, Given]:
        node = tree.value.get("environment_parameters")
        if node is None or node.value is None:
            return {}
        if not isinstance(node.value, dict):
            raise ConfigError(f"{self.place(node, 'environment_parameters')} must hold parameters by name")
        return {
            name: Given(item.plain, self.place(item, f"environment_parameters.{name}"))
            for name, item in node.value.items()
        }

    def _flat(self, node: Node, root: str, default: Section | None = None) -> dict[str, Given]:
        if node.value is None:
            return {}
        if not isinstance(node.value, dict):
            raise ConfigError(f"{self.place(node, root)} must hold keys, such as trainer_type: ppo")
        self._refuse_sac(node, root, default)
        out: dict[str, Given] = {}
        self._take(node, root, "", BEHAVIOR, out)
        return out

    def _refuse_sac(self, node: Node, root: str, default: Section | None) -> None:
        kind = node.value.get("trainer_type")
        if kind is None or kind.value != "sac":
            return
        hyper = node.value.get("hyperparameters")
        inside = hyper.value if hyper is not None and isinstance(hyper.value, dict) else {}
        own = [name for name in inside if f"hyperparameters.{name}" not in BEHAVIOR]
        alone = f"; its {', '.join(own)} mean nothing to ppo" if own else ""
        raise ConfigError(
            f"{self.place(kind, root + '.trainer_type')}: sac is not supported, this trainer learns on-policy: "
            f"give ppo or poca, with hyperparameters of theirs{alone}"
        )

    def _take(
        self, node: Node, root: str, prefix: str, table: Mapping[str, Key], out: dict[str, Given]
    ) -> None:
        """Take a section's keys; `root` names it in messages, `prefix` in the table."""
        if not isinstance(node.value, dict) or (not node.value and prefix not in OPTIONAL):
            empty = "is empty" if not node.value else "must hold keys"
            raise ConfigError(f"{self.place(node, root)} {empty}: give keys, or leave it out")

        for name, item in node.value.items():
            key = f"{prefix}.{name}" if prefix else name
            where = self.place(item, f"{root}.{name}")
            if key in table:
                out[key] = Given(checked(item.plain, table[key], where), where)
            elif not any(known.startswith(f"{key}.") for known in table):
                raise ConfigError(self._unknown(where, name, prefix, table))
            elif key == "reward_signals" and item.value == {}:
                raise ConfigError(f"{where} is empty: name a signal, such as extrinsic:")
            else:
                is_switch = key in OPTIONAL or key.count(".") == 1 and prefix == "reward_signals"
                if is_switch and (item.value is None or item.value == {}):
                    out[key] = Given(item.value if key in OPTIONAL else {}, where)
                    continue
                self._take(item, f"{root}.{name}", key, table, out)

    def _unknown(self, where: str, name: str, prefix: str, table: Mapping[str, Key]) -> str:
        if table is BEHAVIOR and name in RENAMED:
            new = RENAMED[name]
            return f"{where} is an old spelling: " + (f"{new} now" if new else "there is none any more")

        elsewhere = [key for key in table if key.rpartition(".")[2] == name]
        if elsewhere:
            return f"{where} does not stand there: it is {elsewhere[0]}"

        cut = len(prefix) + 1 if prefix else 0
        inside = [key for key in table if key.startswith(f"{prefix}." if prefix else "")]
        names = list(dict.fromkeys(key[cut:].partition(".")[0] for key in inside))
        return f"{where} is no key of ML-Agents{did_you_mean(name, names)}; keys there: {', '.join(names)}"


def _merged(default: dict[str, Given], own: dict[str, Given]) -> dict[str, Given]:
    """Return a behavior's keys above the default's; a section that it sets to null is off."""
    off = [key for key, given in own.items() if given.value is None and key in OPTIONAL]
    kept = {
        key: given
        for key, given in default.items()
        if not any(key == name or key.startswith(f"{name}.") for name in off)
    }
    # a section that the default has switched off, and the behavior fills
    for name in OPTIONAL:
        if name in kept and kept[name].value is None and any(key.startswith(f"{name}.") for key in own):
            del kept[name]
    return kept | own


def _number(value: Any) -> float | None:
    if isinstance(value, bool) or not isinstance(value, (int, float, str)):
        return None
    try:
        number = float(value)  # YAML takes 5e5 for a text
    except ValueError:
        return None
    return number if math.isfinite(number) else None


def _shown(value: Any) -> str:
    return repr(value) if isinstance(value, str) else show_value(value)
