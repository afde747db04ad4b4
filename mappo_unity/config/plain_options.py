"""Mistakes in the form of option=value, for the commands without presets.

Those are mappo-eval, mappo-play, mappo-export, mappo-league, mappo-plot, mappo-report, mappo-hub, and
mappo-search for its own options. Switches, words alone and options given twice are told with how they are
written.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Sequence
from pathlib import Path

from mappo_unity.config.option_table import Option, did_you_mean, find_option, option_table
from mappo_unity.config.overrides import parse, shell_word
from mappo_unity.config.presets import group_choices
from mappo_unity.config.schema import (
    Config,
    EvalConfig,
    ExportConfig,
    LeagueConfig,
    PlayConfig,
    PlotConfig,
    PullConfig,
    PushConfig,
    ReportConfig,
    SearchConfig,
)
from mappo_unity.config.text_lines import quoted_path
from mappo_unity.errors import ConfigError

COMMANDS = {
    "mappo-train": Config,
    "mappo-eval": EvalConfig,
    "mappo-play": PlayConfig,
    "mappo-export": ExportConfig,
    "mappo-league": LeagueConfig,
    "mappo-plot": PlotConfig,
    "mappo-report": ReportConfig,
    "mappo-hub push": PushConfig,
    "mappo-hub pull": PullConfig,
    "mappo-search": SearchConfig,
}
"""The commands that take option=value, and their options."""

# with an even number of backslashes before it; an odd number makes it a text
_INTERPOLATION = re.compile(r"(?<!\\)(?:\\\\)*\$\{")


def check_form(lines: Sequence[str], schema: type) -> None:
    """Raise ConfigError for arguments that are not of the form option=value, or that give an option twice."""
    table = option_table(schema)
    seen: dict[str, str] = {}

    for number, line in enumerate(lines):
        key = line.partition("=")[0]
        if line.startswith("-"):
            raise ConfigError(_switch(lines, number, table))
        if "=" not in line:
            raise ConfigError(_word(lines, number, table))

        if key in seen:
            raise ConfigError(f"{key} is given twice, {seen[key]} and {line}: give it once")
        seen[key] = line

        if key not in table:
            _check_other_command(key, schema, table)
        if _INTERPOLATION.search(line):
            raise ConfigError(f"{line}: ${{...}} is for the options of mappo-train; write the value itself")

    # only now: of switches and words alone the grammar's own message says too little
    for override, line in zip(parse(list(lines)), lines):
        if override.is_sweep_override():
            raise ConfigError(
                f"{line}: {override.key_or_group} takes one value; a text with a comma stands in quotes "
                f"inside quotes, {override.key_or_group}='\"like, this\"'"
            )


def take_parameters(lines: Sequence[str], below: str = "env.params") -> tuple[list[str], list[str]]:
    """Return the lines that set environment parameters, in mappo-train's grammar, and all others.

    `below`: the section whose options are taken; "env" takes all options of the environment.

    Raises:
        ConfigError: one has several values.
    """
    pattern = r"env\." if below == "env" else rf"{re.escape(below)}[.=]"
    own = [line for line in lines if re.match(pattern, line)]
    for override, line in zip(parse(own), own):
        if override.is_sweep_override():
            raise ConfigError(f"{line}: {override.key_or_group} takes one value here")
    return own, [line for line in lines if line not in own]


def take_words(lines: Sequence[str], schema: type, option: str) -> list[str]:
    """Return the lines with the words before the options as one option: policies of mappo-league, runs.

    Raises:
        ConfigError: a word stands behind an option.
    """
    table = option_table(schema)
    words: list[str] = []
    rest = list(lines)
    # the name of a folder may have = in it: ppo.lr=1e-4 is what a sweep calls one
    while rest and not rest[0].startswith("-") and ("=" not in rest[0] or _is_folder(rest[0], table)):
        words.append(rest.pop(0))

    for line in rest:
        if "=" not in line and line not in table and not any(word.startswith("-") for word in rest):
            raise ConfigError(f"{line!r} stands behind {rest[0]}: the {option} come first, then the options")
    return [f"{option}=[{','.join(map(quoted_path, words))}]", *rest] if words else rest


def _is_folder(word: str, table: dict[str, Option]) -> bool:
    return word.partition("=")[0] not in table and Path(word).exists()


def _check_other_command(key: str, schema: type, table: dict[str, Option]) -> None:
    """Raise ConfigError for an option that another command has."""
    tables = {name: option_table(other) for name, other in COMMANDS.items() if other is not schema}
    owners = [name for name, other in tables.items() if find_option(other, key) is not None]

    if key in group_choices() or key.startswith(("hydra.", "hydra/")):
        owners = ["mappo-train"]

    if not owners:
        return

    own = next((name for name, other in COMMANDS.items() if other is schema), "this command")
    hint = ": a run's own options count" if owners == ["mappo-train"] else ""
    raise ConfigError(
        f"{key} is an option of {' and '.join(owners)}, not of {own}{hint}; options here: {', '.join(table)}"
    )


def _switch(lines: Sequence[str], number: int, table: dict[str, Option]) -> str:
    """Say how a switch (--run=x, --run x) is written here."""
    key, equals, value = lines[number].partition("=")
    name = key.lstrip("-").replace("-", "_")
    rule = "options are written option=value, and the only switches are --help and --version"

    if name not in table:
        return f"{key} is not an option{_near(name, table)}: {rule}"

    # --run=x has its value in it, --run x in the next word
    following = [value] if equals else lines[number + 1 : number + 2]
    return f"{key} is written {name}={_value(following, table[name])}: {rule}"


def _word(lines: Sequence[str], number: int, table: dict[str, Option]) -> str:
    """Say what a word alone may have been meant for: an option's name, or a value."""
    word = lines[number]
    rest = [line.removeprefix("=") for line in lines[number + 1 : number + 3] if line != "="]

    if word in table:
        value = _value(rest, table[word])
        return f"{word} has no value: it is written {word}={value}, without spaces"

    # run:x
    name, colon, value = word.partition(":")
    if colon and name in table:
        return f"{word!r} is not of the form option=value: it is written {name}={shell_word(value)}"

    guess = f" (did you mean {next(iter(table))}={shell_word(word)}?)" if word else ""
    hint = _near(word, table) or guess
    return f"{word!r} is not of the form option=value{hint}; options: {', '.join(table)}"


def _near(name: str, table: dict[str, Option]) -> str:
    """Return a hint at the option or switch that a misspelt name is like, or an empty text."""
    switches = difflib.get_close_matches(name.lower(), ["help", "version"], 1, 0.7)
    return f" (did you mean --{switches[0]}?)" if switches else did_you_mean(name, table)


def _value(following: Sequence[str], option: Option) -> str:
    """Return what may have been meant as an option's value: the next word, if it is one."""
    if option.type is bool:
        return "true"

    alone = [word for word in following[:1] if word and "=" not in word and not word.startswith("-")]
    return shell_word(alone[0]) if alone else "VALUE"
