"""Sweeps: many runs from one command line, through Hydra's grid and its launchers.

A sweep's folder holds a run folder for each job, with its result.json. A job that fails leaves the others
alone.
"""

from __future__ import annotations

import json
import math
import signal
import time
import traceback
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path

from hydra._internal.hydra import Hydra
from hydra._internal.utils import create_config_search_path
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from omegaconf import DictConfig

from mappo_unity.config.behavior_lines import all_to_hydra_syntax, dotted_options
from mappo_unity.config.compose import register_root, settle, to_config
from mappo_unity.config.overrides import add_plus_prefix, last_value, parse
from mappo_unity.config.presets import conf_dir
from mappo_unity.config.schema import Config
from mappo_unity.config.text_lines import quoted_path
from mappo_unity.errors import ConfigError
from mappo_unity.policies.warm_start.sources import adopt_file_options
from mappo_unity.runs.atomic import write_atomically
from mappo_unity.runs.folder import (
    METRICS,
    NewFolder,
    checkpoint_of_job,
    create_folder,
    discard_folder,
    write_record,
)
from mappo_unity.runs.lock import locked
from mappo_unity.runs.metrics_csv import STEP, read_metrics
from mappo_unity.runs.progress import job_of_sweep
from mappo_unity.scenes.factory import check_factory
from mappo_unity.signals import Interrupted, interrupts_wait
from mappo_unity.training.plan import Plan, plan_jobs
from mappo_unity.training.sweep_signals import (
    SweepSignalHandler,
    hand_to_launcher,
    in_process_of_its_own,
    job_signals,
    sweep_signals,
)

RESULT = "result.json"
GOOD = ("finished", "solved")
_GRID = "multirun.yaml"  # Hydra's record of a grid
_SEVERAL = "several"  # stands for env.name in the sweep's folder where the jobs differ in it


@dataclass
class JobResult:
    """What result.json holds of a job; wall_s in seconds, agent_steps in agent decisions."""

    job: int
    overrides: list[str]
    status: str
    return_mean: float | None = None
    agent_steps: int | None = None
    wall_s: float = 0.0
    error: str | None = None


@dataclass
class SweepResult:
    """What became of a sweep: its folder, its jobs (best first) and how it ended."""

    folder: Path
    jobs: list[JobResult] = field(default_factory=list)
    signal: int | None = None
    error: str | None = None

    @property
    def exit_code(self) -> int:
        """0 if every job succeeded, 128 + signal if one ended the sweep, else 1."""
        if self.signal is not None:
            return 128 + self.signal
        return 0 if self.jobs and not self.error and all(job.status in GOOD for job in self.jobs) else 1


def run_sweep(lines: list[str], file: Path | None = None) -> SweepResult:
    """Check every job's options, then run the jobs; raises ConfigError before the first one starts.

    `file` holds options below those of the lines.
    """
    plan = plan_jobs(lines, file, lambda text: print(text, flush=True))
    folder = _sweep_folder(lines, plan)
    result, patience = SweepResult(folder.path), SweepSignalHandler()

    try:
        with sweep_signals(patience, parallel=last_value(lines, "hydra/launcher") == "joblib"):
            _launch(
                [*_without(lines, "hydra.sweep.dir"), f"hydra.sweep.dir={quoted_path(folder.path)}"], file
            )
    except KeyboardInterrupt as error:
        result.signal = getattr(error, "signal", int(signal.SIGINT))
    except HydraException as error:
        discard_folder(folder)
        raise ConfigError(f"the sweep cannot start: {' '.join(str(error).split())}") from error
    except Exception as error:
        if patience.number is None:  # else a launcher misses the jobs that were ended
            _refuse_unstarted(folder, error)
            traceback.print_exc()
            result.error = f"{type(error).__name__}: {error}"

    # where jobs run side by side, the first signal raised nothing
    result.signal = result.signal or patience.number
    result.jobs = _rank(_read_results(folder.path) + _missing(folder.path, plan.jobs))
    return result


def run_job(tree: DictConfig) -> float | None:
    """Run one job in the folder that Hydra gave it, write result.json, return return_mean.

    Never raises for a failure of the job (it is in the result); raises Interrupted where a signal
    ended it, so that the sweep ends too (in a process of its own it returns None, for later jobs too).
    """
    with job_signals() as may_begin:
        return _run_job(tree) if may_begin else None
    # reached where `job_signals` kept an Interrupted to itself
    return None


def _run_job(tree: DictConfig) -> float | None:
    hydra = HydraConfig.get()
    folder = Path(hydra.runtime.output_dir)
    result = JobResult(int(hydra.job.num), [line.lstrip("+") for line in hydra.overrides.task], "failed")
    # One write, its newline included: jobs print side by side.
    print(f"job {result.job}: {' '.join(result.overrides)}\n", end="", flush=True)

    start_s = time.monotonic()
    ended_by: int | None = None

    try:
        with locked(folder):
            settle(tree, list(hydra.overrides.task))
            config = adopt_file_options(to_config(tree), result.overrides)
            ended_by = _train(config, folder, result)
    except KeyboardInterrupt as error:
        result.status = "interrupted"
        ended_by = getattr(error, "signal", int(signal.SIGINT))
    except Exception as error:
        note_failure(result, folder, error)

    # Whatever became of the job: its result is there before a signal goes on to the sweep.
    result.wall_s = round(result.wall_s or time.monotonic() - start_s, 3)
    write_atomically(folder / RESULT, (json.dumps(asdict(result), indent=2) + "\n").encode())

    if ended_by is not None:
        hand_to_launcher(ended_by)
        raise Interrupted(ended_by)
    return result.return_mean


def note_failure(result: JobResult, folder: Path, error: Exception) -> None:
    """Enter an error that is being handled into a job's result, and write its traceback to error.txt."""
    folder.mkdir(parents=True, exist_ok=True)  # somebody may have removed it
    result.error = str(error) if isinstance(error, ConfigError) else f"{type(error).__name__}: {error}"
    (folder / "error.txt").write_text(traceback.format_exc(), encoding="utf-8")

    # who resumes the job goes on from here
    with suppress(OSError, ValueError, LookupError):
        result.agent_steps = int(read_metrics(folder / METRICS)[-1][STEP])


def varied_options(jobs: list[JobResult]) -> list[str]:
    """Return the options in which the jobs differ, in the order of the command line."""
    values: dict[str, set[str]] = {}
    for job in jobs:
        for key, value in job_options(job).items():
            values.setdefault(key, set()).add(value)

    return [key for key, seen in values.items() if len(seen) > 1]


def job_options(job: JobResult) -> dict[str, str]:
    """Return a job's overrides by option name."""
    options: dict[str, str] = {}
    for line in job.overrides:
        options |= dotted_options(line)
    return options


def _train(config: Config, folder: Path, result: JobResult) -> int | None:
    write_record(folder, config, result.overrides)
    check_factory(config.env)
    with interrupts_wait():
        from mappo_unity.training.trainer import train

    # the folder was new: what lies there is of this job, which its scheduler has started again
    checkpoint = checkpoint_of_job(folder)
    with job_of_sweep(result.job, in_process_of_its_own()):
        outcome = train(config, folder, checkpoint)

    result.status = outcome.status
    # JSON has no nan
    mean = outcome.return_mean
    result.return_mean = mean if mean is not None and math.isfinite(mean) else None
    result.agent_steps = outcome.agent_steps
    result.wall_s = outcome.wall_s
    return outcome.signal


def _refuse_unstarted(folder: NewFolder, error: Exception) -> None:
    """Raise ConfigError where a sweep broke off before its first job: its plugins refuse their options so."""
    if any(path.is_dir() for path in folder.path.iterdir()):
        return

    (folder.path / _GRID).unlink(missing_ok=True)
    discard_folder(folder)
    reason = " ".join(str(error).split()) or type(error).__name__
    raise ConfigError(f"the sweep cannot start: {reason} (hydra.sweeper and hydra.launcher)") from error


def _launch(lines: list[str], file: Path | None) -> None:
    # Hydra refuses to start where an earlier one of this process is left.
    GlobalHydra.instance().clear()
    search_path = create_config_search_path(str(conf_dir()))
    hydra = Hydra.create_main_hydra2("mappo-train", search_path)
    try:
        lines = [add_plus_prefix(line) for line in all_to_hydra_syntax(lines)]
        if last_value(lines, "hydra/launcher") in (None, "basic"):
            # Hydra composes a whole batch before its first job.
            lines = ["hydra.sweeper.max_batch_size=1", *lines]

        hydra.multirun(register_root(lines, file=file), run_job, lines)
    finally:
        GlobalHydra.instance().clear()


def _sweep_folder(lines: list[str], plan: Plan) -> NewFolder:
    names = {config.env.name for config in plan.configs}
    name = names.pop() if len(names) == 1 else _SEVERAL
    return create_folder(plan.first.sweep_dir(name), exact=last_value(lines, "hydra.sweep.dir") is not None)


def _read_results(folder: Path) -> list[JobResult]:
    found = sorted(folder.rglob(RESULT))
    return [JobResult(**json.loads(path.read_text(encoding="utf-8"))) for path in found]


def _missing(folder: Path, planned: list[list[str]]) -> list[JobResult]:
    """Return the jobs of a grid that left no result: not started, or their process died."""
    multirun = folder / _GRID
    if not multirun.is_file():  # the launcher broke off before
        return []

    done = {job.job for job in _read_results(folder)}
    return [
        JobResult(number, [line.lstrip("+") for line in job], "no result")
        for number, job in enumerate(planned)
        if number not in done
    ]


def _rank(jobs: list[JobResult]) -> list[JobResult]:
    def key(job: JobResult) -> tuple[bool, float, int]:
        mean = job.return_mean
        return (mean is None, -mean if mean is not None else 0.0, job.job)

    return sorted(jobs, key=key)


def _without(lines: list[str], key: str) -> list[str]:
    return [line for line in lines if parse([line])[0].key_or_group != key]
