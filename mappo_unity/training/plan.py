"""The jobs of a sweep, every one checked before the first one starts."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.override_parser.types import Override
from omegaconf import DictConfig, OmegaConf, open_dict

from mappo_unity.config.behavior_lines import all_to_hydra_syntax
from mappo_unity.config.compose import (
    Composed,
    check_effect,
    compose_config,
    compose_tree,
    settle,
    to_config,
)
from mappo_unity.config.overrides import check_overrides, last_value, parse, range_length
from mappo_unity.config.presets import group_choices
from mappo_unity.config.schema import Config
from mappo_unity.errors import ConfigError
from mappo_unity.policies.first_checks import check_environment
from mappo_unity.policies.warm_start.sources import adopt_file_options

MANY = 200  # jobs whose check takes so long that it is announced
_BATCH = "hydra.sweeper.max_batch_size"
_PROCESSES = "hydra.launcher.n_jobs"


@dataclass(frozen=True)
class Plan:
    """The overrides of each job of a grid, and what comes of them."""

    jobs: list[list[str]]
    configs: list[Config]
    first: Composed


def plan_jobs(
    lines: list[str], file: Path | None = None, say: Callable[[str], None] = lambda text: None
) -> Plan:
    """Return the jobs of a sweep, all checked; `file` holds options below them.

    `say` is told when the check takes a while. Raises ConfigError.
    """
    check_overrides(lines, Config, group_choices(), sweep=True)
    if last_value(lines, "resume") is not None:
        raise ConfigError("resume cannot be swept: continue one run at a time, without -m")

    task = all_to_hydra_syntax([line for line in lines if not is_hydra(line)])
    hydra = [line for line in lines if is_hydra(line)]

    # the sizes come first: a grid that is too large is refused before its jobs are listed
    counts = _count_values(task)
    job = _first_job(task)
    first = _named(lambda: compose_config([*job, *hydra], file=file), job)
    _check_size(counts, first.config.max_jobs, say)
    jobs = [list(job) for job in BasicSweeper.split_arguments(parse(task), None)[0]]

    _check_plugins(first.tree)
    configs = _configs(jobs, hydra, file, first)

    for job, config in zip(jobs, configs):
        adopt_file_options(config, job, file)
    # Jobs mostly share their environment: it is looked at once for each factory.
    for config in {config.env.factory: config for config in configs}.values():
        check_environment(config)

    check_effect(list(dict.fromkeys(line for job in jobs for line in job)), configs)
    return Plan(jobs, configs, first)


def is_hydra(line: str) -> bool:
    """Return whether an override is one of Hydra's own options, which the jobs do not have."""
    return line.lstrip("+~").startswith(("hydra.", "hydra/"))


def _count_values(lines: list[str]) -> dict[str, int]:
    """Return how many values each option has; the last line of an option counts, as it does for Hydra."""
    counts: dict[str, int] = {}
    for line, override in zip(lines, parse(lines)):
        if override.is_sweep_override() and not override.is_discrete_sweep():
            raise ConfigError(
                f"{line}: an interval has no list of values; mappo-search searches one, "
                f"or give values: {override.key_or_group}=a,b,c"
            )

        count = _length(override)
        if count == 0:
            raise ConfigError(f"{line} has no value: the sweep would be empty")
        counts[override.key_or_group] = count

    return counts


def _length(override: Override) -> int:
    if not override.is_sweep_override():
        return 1
    if override.is_range_sweep():
        return range_length(override)
    return len(list(override.sweep_iterator()))


def _first_job(lines: list[str]) -> list[str]:
    job = {}
    for override in parse(lines):
        key = override.get_key_element()
        if override.is_sweep_override():
            job[key] = f"{key}={next(iter(override.sweep_string_iterator()))}"
        else:
            job[key] = f"{key}={override.get_value_element_as_str()}"

    return list(job.values())


def _check_size(counts: dict[str, int], limit: int, say: Callable[[str], None]) -> None:
    number = math.prod(counts.values())
    if number > limit:
        sizes = " x ".join(f"{count:,} of {key}" for key, count in counts.items() if count > 1)
        raise ConfigError(
            f"the sweep has {number:,} jobs ({sizes}), more than max_jobs={limit}: give fewer values, search "
            f"with mappo-search, or raise the limit: max_jobs={number}"
        )
    if number > MANY:
        say(f"checking the options of {number:,} jobs ...")


def _check_plugins(tree: DictConfig) -> None:
    """Check the numbers of Hydra's grid and launchers, which themselves assert them or go wrong."""
    batch = OmegaConf.select(tree, _BATCH)
    if batch is not None and not (isinstance(batch, int) and batch >= 1):
        raise ConfigError(f"{_BATCH}={batch} is out of range: it must be a whole number >= 1")
    if OmegaConf.select(tree, _PROCESSES) == 0:
        raise ConfigError(f"{_PROCESSES}=0 is out of range: it must be >= 1, or -1 for one job a core")


def _configs(jobs: list[list[str]], hydra: list[str], file: Path | None, first: Composed) -> list[Config]:
    """Return each job's options; composed anew, which takes long, are only those that need it."""
    if len(jobs) == 1:
        return [first.config]

    swept = {key for key, values in _values(jobs).items() if len(values) > 1}
    trees: dict[tuple[str, ...], DictConfig] = {}
    configs = []

    for job in jobs:
        overrides = parse(job)
        presets = tuple(
            line for line, override in zip(job, overrides) if override.key_or_group in group_choices()
        )
        changed = [override for override in overrides if override.get_key_element() in swept]
        # Several options given as one are merged with what was there before.
        is_merged = any(isinstance(override.value(), dict) for override in changed)

        # Jobs with the same presets differ in plain values only: those are set in a tree composed before.
        if presets not in trees or is_merged:
            trees[presets] = _options(_compose_job(job, hydra, file))
        configs.append(_changed(trees[presets], changed, job))

    return configs


def _values(jobs: list[list[str]]) -> dict[str, set[str]]:
    values: dict[str, set[str]] = {}
    for job in jobs:
        for line in job:
            key, _, value = line.partition("=")
            values.setdefault(key, set()).add(value)
    return values


def _options(tree: DictConfig) -> DictConfig:
    tree = tree.copy()
    with open_dict(tree):
        tree.pop("hydra", None)
    return tree


def _changed(tree: DictConfig, overrides: list[Override], job: list[str]) -> Config:
    tree = tree.copy()
    for override in overrides:
        # presets are in the tree already
        if override.key_or_group not in group_choices():
            OmegaConf.update(tree, override.key_or_group, override.value(), merge=True, force_add=True)

    def settled() -> Config:
        settle(tree, job)
        return to_config(tree)

    return _named(settled, job)


def _compose_job(job: list[str], hydra: list[str], file: Path | None) -> DictConfig:
    return _named(lambda: compose_tree([*job, *hydra], file=file), job)


def _named(make: Callable[[], Any], job: list[str]) -> Any:
    try:
        return make()
    except ConfigError as error:
        raise ConfigError(f"{error} (in the job {' '.join(job) or 'as given'})") from error
