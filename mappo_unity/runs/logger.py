"""Metrics out of a run: ``metrics.csv`` always, TorchRL's loggers by choice, progress on the terminal.

It takes one row of numbers an iteration. A resumed run appends to its files, without repeated rows.
"""

from __future__ import annotations

import importlib.util
import math
import numbers
import os
import threading
import uuid
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Console

from mappo_unity.config.extras import install_command
from mappo_unity.config.overrides import shell_argument
from mappo_unity.config.schema import LogConfig, LoggerKind, TagKind
from mappo_unity.errors import ConfigError
from mappo_unity.runs.behavior_events import BehaviorEvents
from mappo_unity.runs.folder import METRICS
from mappo_unity.runs.metrics_csv import STEP, MetricsFile, keep_until, read_metrics
from mappo_unity.runs.progress import Progress, current_job

if TYPE_CHECKING:
    from torchrl.record.loggers.common import Logger

_BINS = {"TensorboardLogger": "tensorflow", "WandbLogger": 64}
"""Of histograms, for the loggers that take them: those that the packages take by themselves."""

__all__ = ["RunLog", "check_loggers", "read_metrics"]


def check_loggers(cfg: LogConfig) -> None:
    """Raise ConfigError where a logger's package is not installed; quick, imports nothing."""
    for backend in (LoggerKind.wandb, LoggerKind.mlflow):
        if backend in cfg.loggers and importlib.util.find_spec(backend.name) is None:
            raise ConfigError(
                f"log.loggers has {backend.name}, but the package {backend.name} is not installed: "
                f"{install_command(backend.name)}, or leave it out (log.loggers=[tensorboard]; "
                f"choices: {', '.join(choice.name for choice in LoggerKind)})"
            )


class RunLog:
    """Take a run's metrics, one row an iteration; also a context manager that closes itself.

    `folder` is the run's. With `resume_steps` given (agent decisions at the checkpoint that is resumed)
    what the run wrote after that is removed first, from ``metrics.csv``, TensorBoard events and TorchRL's
    CSV files (damaged rows too, with a message and a copy of the file as it was); W&B and MLflow keep it: W&B
    resumes the same run, MLflow starts another one. Log a row before the checkpoint of its iteration is
    written, and no row is lost either. `console`: where progress and messages go, standard output by default.

    Raises ConfigError for a logger that is not installed, and for a new run in a folder that has metrics.
    """

    def __init__(
        self,
        cfg: LogConfig,
        folder: Path,
        max_steps: int,
        resume_steps: int | None = None,
        console: Console | None = None,
    ) -> None:
        check_loggers(cfg)
        metrics = folder / METRICS
        self._console = console or Console()

        if resume_steps is not None:
            for note in keep_until(folder, resume_steps):
                self.message(note)
        elif metrics.exists():
            raise ConfigError(
                f"{metrics} exists already; resume that run ({shell_argument('resume', folder)}) or take "
                "another folder"
            )

        folder.mkdir(parents=True, exist_ok=True)
        self._folder = folder
        self._progress = Progress(self._console, max_steps) if cfg.progress else None
        self._metrics = MetricsFile(metrics)

        # TensorBoard writes from a thread, whose errors Python would print in the middle of ours.
        self._excepthook = threading.excepthook
        threading.excepthook = self._on_thread_error

        # After `keep_until`: they append to the files that it trims.
        kinds = list(dict.fromkeys(cfg.loggers))
        self._events: BehaviorEvents | None = None
        if cfg.tags is TagKind.mlagents and LoggerKind.tensorboard in kinds:
            kinds.remove(LoggerKind.tensorboard)
            self._events = BehaviorEvents(folder, cfg.summary_freq)
        self._loggers = [_make_logger(backend, cfg, folder) for backend in kinds]

    def log(self, row: Mapping[str, Any], histograms: Mapping[str, np.ndarray] | None = None) -> None:
        """Record a row: numbers by name, with ``agent_steps``; NaN (no episode yet) goes to the CSV only.

        Values of `histograms` go to TensorBoard and W&B, as NAME_hist.

        When this returns the row outlives a kill of the process, in ``metrics.csv`` and in the event files.
        Raises ConfigError where it cannot be written.
        """
        numbers_by_name = {name: _plain(value) for name, value in row.items()}

        try:
            self._write(numbers_by_name, histograms or {})
        except OSError as error:
            raise ConfigError(self._explain(error)) from error

        if self._progress is not None:
            self._progress.update(numbers_by_name)

    def _write(self, row: Mapping[str, int | float], histograms: Mapping[str, np.ndarray]) -> None:
        if not self._folder.is_dir():  # an open file could be written to all the same, and is lost
            raise FileNotFoundError(self._folder)

        self._metrics.append(row)

        for line in self._events.add(row) if self._events is not None else ():
            self.message(line)

        step = int(row[STEP])
        curves = {name: x for name, x in row.items() if name != STEP and not math.isnan(x)}

        for logger in self._loggers:
            logger.log_metrics(curves, step=step)
            bins = _BINS.get(type(logger).__name__)
            for name, values in histograms.items() if bins else ():
                logger.log_histogram(f"{name}_hist", values, step=step, bins=bins)
            logger.flush()

    def _explain(self, error: OSError) -> str:
        if not self._folder.is_dir():
            return (
                f"the run folder {self._folder} was removed or moved while the run was training: it ends here"
            )

        what = f"the metrics in {self._folder} cannot be written ({error.strerror or error})"
        if not any((self._folder / "checkpoints").glob("*.pt")):
            return f"{what}, and there is no checkpoint yet to resume from: free some space and start again"
        return (
            f"{what}; the checkpoints there stay as they are. Free some space, then resume with "
            f"{shell_argument('resume', self._folder)}"
        )

    def message(self, text: str) -> None:
        """Print a line above the progress line; in a sweep it names its job."""
        self._console.print(current_job().mark + text, markup=False, highlight=False, soft_wrap=True)

    def message_if_possible(self, text: str) -> None:
        """Print a line, unless whoever read them is gone or the disk they went to is full."""
        with suppress(OSError):
            self.message(text)

    def close(self) -> None:
        """Finish the progress line and close files and loggers; again: nothing."""
        if self._progress is not None:
            self._progress.close()
            self._progress = None

        with suppress(OSError):  # every row has been flushed; what a full disk refused has been said
            self._metrics.close()

        if self._events is not None:
            with suppress(OSError):
                self._events.close()

        while self._loggers:
            with suppress(OSError):
                _close_logger(self._loggers.pop())

        # Last: a writing thread may still fail while its logger is closed.
        threading.excepthook = self._excepthook

    def _on_thread_error(self, args: threading.ExceptHookArgs) -> None:
        """Leave out what TensorBoard's writing thread says: its error is raised again by the next flush."""
        writes = type(args.thread).__module__.startswith("tensorboard.")
        if not (writes and isinstance(args.exc_value, OSError)):
            self._excepthook(args)

    def __enter__(self) -> RunLog:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _plain(value: Any) -> int | float:
    return int(value) if isinstance(value, numbers.Integral) else float(value)


def _make_logger(backend: LoggerKind, cfg: LogConfig, folder: Path) -> Logger:
    from torchrl.record import loggers

    name = "/".join(folder.resolve().parts[-2:])

    if backend is LoggerKind.csv:
        return loggers.CSVLogger("csv", log_dir=str(folder))
    if backend is LoggerKind.tensorboard:
        return loggers.TensorboardLogger("tensorboard", log_dir=str(folder))
    if backend is LoggerKind.wandb:
        return loggers.WandbLogger(
            name, save_dir=str(folder), id=_wandb_id(folder / "wandb_id"), project=cfg.project
        )

    uri = os.environ.get("MLFLOW_TRACKING_URI") or f"sqlite:///{folder.resolve() / 'mlflow.db'}"
    return loggers.MLFlowLogger(cfg.project, tracking_uri=uri, tags={"run": name})


def _wandb_id(path: Path) -> str:
    """Return the id under which W&B knows the run of this folder: made once, so that resuming finds it."""
    if not path.exists():
        path.write_text(uuid.uuid4().hex)
    return path.read_text().strip()


def _close_logger(logger: Logger) -> None:
    from torchrl.record.loggers import MLFlowLogger

    if isinstance(logger, MLFlowLogger):  # its run would stay active and refuse the next one of a sweep
        import mlflow

        mlflow.end_run()

    logger.close()
