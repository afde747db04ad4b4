"""Everything about a search that options alone can tell, looked at before its folder is made. No torch."""

from __future__ import annotations

import importlib.metadata
import json
from dataclasses import dataclass
from functools import reduce
from pathlib import Path
from typing import Any

from mappo_unity.config.compose import check_effect, compose_config
from mappo_unity.config.extras import install_command
from mappo_unity.config.option_table import did_you_mean, find_option, option_table
from mappo_unity.config.overrides import given_options
from mappo_unity.config.presets import group_choices
from mappo_unity.config.schema import Config, SearchConfig, SearchObjective
from mappo_unity.errors import ConfigError
from mappo_unity.policies.first_checks import check_environment
from mappo_unity.policies.warm_start.sources import adopt_file_options
from mappo_unity.runs.json_record import record_to_resume
from mappo_unity.training.search.space import Space, read_space, to_line

RECORD = "search.json"
"""What a search is, in its folder: a later call with the same goes on with it."""
_OPTUNA = 4  # the first version of what is used here
_REFUSED = {
    "resume": "a search goes on with the same out=FOLDER",
    "output_dir": "out=FOLDER is the place of all trials",
}


@dataclass(frozen=True)
class SearchPlan:
    """A checked search.

    Attributes: `lines`, the options of all trials; `file`, options below them; `preset`, what the space's
    options are without a search, where all of that lies in the space; `first_seed` of each trial's runs;
    `max_steps`, agent decisions of a run at most.
    """

    options: SearchConfig
    objective: SearchObjective
    space: Space
    lines: list[str]
    file: Path | None
    preset: dict[str, Any] | None
    first_seed: int
    max_steps: int
    folder: Path

    def record(self) -> dict[str, Any]:
        """Return what must not change from call to call."""
        options = self.options
        return {
            "space": {key: vars(entry) for key, entry in self.space.items()},
            "options": self.lines,
            "config": None if self.file is None else str(self.file),
            "objective": self.objective.name,
            "goal": options.goal,
            "seeds": options.seeds,
            "pruner": options.pruner.name,
        }


def split_lines(lines: list[str]) -> tuple[list[str], list[str]]:
    """Return the lines of mappo-search itself, and those for mappo-train.

    Raises:
        ConfigError: a name that neither of them has.
    """
    own, table = option_table(SearchConfig), option_table(Config)
    for line in lines:
        key = line.partition("=")[0].lstrip("+~")
        is_known = key in own or key in group_choices() or find_option(table, key) is not None
        is_known = is_known or key.startswith("hydra")  # refused with its own reason
        if "=" in line and not is_known and not line.startswith("-"):
            names = [*own, *group_choices(), *table]
            raise ConfigError(
                f"{key} is an option neither of mappo-search nor of mappo-train{did_you_mean(key, names)}; "
                f"choices: {', '.join(own)} and those of mappo-train --help"
            )

    mine = [line for line in lines if line.partition("=")[0] in own]
    return mine, [line for line in lines if line not in mine]


def check_search(options: SearchConfig, lines: list[str], file: Path | None) -> SearchPlan:
    """Return the plan of a search; raise ConfigError for what cannot work.

    Args:
        options: of the search.
        lines: options of mappo-train, for all trials.
        file: a YAML file of options below them.
    """
    _check_optuna()
    space = read_space(options.search)
    given = given_options(lines)
    for key in given:
        if key in _REFUSED or key.startswith("hydra"):
            raise ConfigError(f"{key} does not go with a search: {_REFUSED.get(key, 'it has no sweep')}")
        if key in space:
            raise ConfigError(
                f"{key} is searched (search={options.search}) and given on the command line: leave it out, "
                "or use a space of your own without it"
            )
    if options.goal is not None:
        if "stop_at_return" in given:
            raise ConfigError(f"goal={options.goal:g} sets stop_at_return: give one of them")
        lines = [*lines, f"stop_at_return={options.goal:.15g}"]

    config = _check_corners(space, lines, file)
    preset = {key: entry.written(_value(config, key)) for key, entry in space.items()}
    is_inside = all(entry.holds(preset[key]) for key, entry in space.items())

    plan = SearchPlan(
        options,
        options.objective
        or (SearchObjective.final_return if options.goal is None else SearchObjective.decisions),
        space,
        lines=lines,
        file=file,
        preset=preset if is_inside else None,
        first_seed=config.seed,
        max_steps=config.max_steps,
        folder=Path(options.out or "outputs/search"),
    )
    _check_folder(plan)
    return plan


def _check_optuna() -> None:
    try:
        version = importlib.metadata.version("optuna")
    except importlib.metadata.PackageNotFoundError:
        version = ""

    if not version or int(version.split(".")[0]) < _OPTUNA:
        here = f"here is {version}" if version else "which is not installed"
        raise ConfigError(
            f"a search needs the package optuna, {_OPTUNA} or newer, {here}: {install_command('search')}"
        )


def _check_corners(space: Space, lines: list[str], file: Path | None) -> Config:
    """Compose the options with the first and the last values of the space; return them without the space."""
    plain = compose_config(lines, file=file).config

    for number in (0, 1):
        corner = [to_line(key, entry.ends()[number]) for key, entry in space.items()]
        try:
            config = compose_config([*lines, *corner], file=file).config
            check_effect([*lines, *corner], [config])
        except ConfigError as error:
            raise ConfigError(f"{error} (in the trial {' '.join(corner)})") from error

    check_environment(adopt_file_options(config, [*lines, *corner], file))
    return plain


def _value(config: Config, key: str) -> Any:
    """Return an option's value; None where a name of the user's is not set."""

    def step(node: Any, name: str) -> Any:
        return node.get(name) if isinstance(node, dict) else getattr(node, name, None)

    return reduce(step, key.split("."), config)


def _check_folder(plan: SearchPlan) -> None:
    """Raise ConfigError where the folder holds something other than this search."""
    saved = record_to_resume(plan.folder, RECORD, "search")
    if saved is None:
        return

    wanted = json.loads(json.dumps(plan.record()))
    for name in wanted:
        if saved.get(name) != wanted[name]:
            raise ConfigError(
                f"out={plan.folder} holds another search: {name} {json.dumps(saved.get(name))} there, "
                f"{json.dumps(wanted[name])} here; name a new folder, or give the same options"
            )
