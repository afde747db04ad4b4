"""mappo-train --completion SHELL: a script that completes options, their values and presets.

The words stand in the script, so that the shell answers at once, without Python; made anew after an
upgrade, it knows the new options.
"""

from __future__ import annotations

from enum import Enum
from typing import Any

from mappo_unity.config.option_table import Option, option_table, show_value, without_none
from mappo_unity.config.plain_options import COMMANDS
from mappo_unity.config.presets import all_groups, describe_choices, group_choices
from mappo_unity.errors import ConfigError

SWITCH = "--completion"
SHELLS = ("bash", "zsh", "fish")

_SWITCHES = {"mappo-train": ["--config", SWITCH, "-m"]}

# bash takes "=" for the end of a word unless told otherwise; what is left of it must then be left out
_BASH = """\
# completion of the mappo-* commands; put into ~/.bashrc: source <(mappo-train --completion bash)
_mappo_complete() {
    local line=${COMP_LINE:0:COMP_POINT} names values
    local word=${line##* }
    case ${1##*/} in
@CASES@
    esac
    if [[ $word == *=* ]]; then
        COMPREPLY=($(compgen -W "$values" -- "$word"))
        [[ $COMP_WORDBREAKS == *=* ]] && COMPREPLY=("${COMPREPLY[@]#*=}")
    else
        COMPREPLY=($(compgen -W "$names" -- "$word"))
    fi
    return 0
}
complete -o nospace -o default -F _mappo_complete @COMMANDS@
"""
_ZSH = """\
autoload -Uz +X compinit && compinit
autoload -Uz +X bashcompinit && bashcompinit
"""


def completion_script(shell: str) -> str:
    """Return the script for bash, zsh or fish; raise ConfigError for another shell."""
    if shell not in SHELLS:
        raise ConfigError(f"{SWITCH} {shell}: one of {', '.join(SHELLS)}, for example {SWITCH} bash")

    return _fish_script() if shell == "fish" else {"bash": "", "zsh": _ZSH}[shell] + _bash_script()


def completion_words(command: str) -> tuple[list[str], list[str]]:
    """Return what a command's arguments begin with (``env=``), and those with a value (``env=3DBall``)."""
    table = option_table(COMMANDS[command])
    trains = command in ("mappo-train", "mappo-search")
    if trains:  # a search takes its own options, and those of its trials
        table = table | option_table(COMMANDS["mappo-train"])
    values = {option.key: _values(option) for option in table.values() if not option.is_section}

    if trains:
        values |= {group: list(describe_choices(group)) for group in all_groups()}
    elif "env" in values:  # a preset's name
        values["env"] = group_choices()["env"]

    names = [f"{key}=" for key in values] + ["--help", "--version", *_SWITCHES.get(command, [])]
    return names, [f"{key}={value}" for key, some in values.items() for value in some]


def _values(option: Option) -> list[str]:
    inner: Any = without_none(option.type)
    null = ["null"] if inner is not option.type else []

    if inner is bool:
        return ["true", "false", *null]
    if isinstance(inner, type) and issubclass(inner, Enum):
        return [show_value(member) for member in inner] + null
    return null


def _programs() -> dict[str, tuple[list[str], list[str]]]:
    """Return what each program's arguments are; those of its own commands (mappo-hub push) together."""
    programs: dict[str, tuple[dict[str, None], dict[str, None]]] = {}
    for command in COMMANDS:
        program, _, own = command.partition(" ")
        names, values = programs.setdefault(program, ({}, {}))
        more_names, more_values = completion_words(command)
        names |= dict.fromkeys([own] * bool(own) + more_names)
        values |= dict.fromkeys(more_values)
    return {program: (list(names), list(values)) for program, (names, values) in programs.items()}


def _bash_script() -> str:
    programs = _programs()
    cases = [
        f"        {program}) names='{' '.join(names)}' values='{' '.join(values)}' ;;"
        for program, (names, values) in programs.items()
    ]
    return _BASH.replace("@CASES@", "\n".join(cases)).replace("@COMMANDS@", " ".join(programs))


def _fish_script() -> str:
    lines = [
        "# completion of the mappo-* commands; put into config.fish: mappo-train --completion fish | source"
    ]
    for program, (names, values) in _programs().items():
        lines.append(f"complete -c {program} -a '{' '.join(names + values)}'")

    return "\n".join(lines) + "\n"
