"""How a command line becomes a training run: a new one in a folder of its own, or one that is resumed.

Everything that options alone can tell is checked before torch is loaded; a run that is refused leaves nothing
behind.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from mappo_unity.config.compose import check_effect, compose_config
from mappo_unity.config.overrides import given_options, last_value
from mappo_unity.config.schema import Config
from mappo_unity.errors import ConfigError
from mappo_unity.policies.first_checks import check_environment
from mappo_unity.policies.policy_files import check_resumable
from mappo_unity.policies.warm_start.sources import adopt_file_options
from mappo_unity.runs import folder as runs
from mappo_unity.runs.lock import locked
from mappo_unity.runs.options import compose_resumed
from mappo_unity.signals import interrupts_wait

if TYPE_CHECKING:
    from rich.console import Console

    from mappo_unity.training.outcome import Outcome
    from mappo_unity.training.trainer import AfterIteration

Warn = Callable[[str], None]


@dataclass(frozen=True)
class Launched:
    """What became of a run: its folder and outcome.

    Where nothing was left to train, a message and the last checkpoint stand instead of the outcome.
    """

    folder: Path
    outcome: Outcome | None
    message: str = ""
    last_checkpoint: Path | None = None


def launch(
    lines: list[str],
    file: Path | None = None,
    warn: Warn = lambda text: None,
    console: Console | None = None,
    after_iteration: AfterIteration | None = None,
) -> Launched:
    """Train a new run, or resume the one that ``resume=`` names.

    Args:
        lines: options, as on the command line.
        file: a YAML file of options below them.
        warn: takes a line for the user that is no part of the run.
        console: where progress goes; None: standard output.
        after_iteration: see `training.trainer`.

    Raises:
        ConfigError: a mistake in the options, or what `train` raises.
    """
    show = _Show(console, after_iteration)
    resume = last_value(lines, "resume")
    if resume == "":
        raise ConfigError("resume= is empty: it must name a run folder or a checkpoint file")

    if resume is not None:
        _refuse_both(lines)
        return _resume(lines, Path(str(resume)), warn, show)
    return _train_new(lines, file, warn, show)


@dataclass(frozen=True)
class _Show:
    """Where progress goes, and who looks on."""

    console: Console | None
    after_iteration: AfterIteration | None


def _train_new(lines: list[str], file: Path | None, warn: Warn, show: _Show) -> Launched:
    with interrupts_wait():
        composed = compose_config(lines, file=file)
        check_effect(lines, [composed.config])
        config = adopt_file_options(composed.config, lines, file)
        check_environment(config)

    folder = runs.create_folder(composed.run_dir, exact=last_value(lines, "hydra.run.dir") is not None)
    try:
        with _locked(folder.path, warn):
            typed = lines if file is None else [f"--config={file}", *lines]
            runs.write_record(folder.path, config, typed)
            return Launched(folder.path, _train(config, folder.path, None, show))
    except (ConfigError, KeyboardInterrupt) as error:
        runs.discard_folder(folder, error)
        raise


def _refuse_both(lines: list[str]) -> None:
    starts = [name for name in given_options(lines) if name.rpartition(".")[2] == "init_from"]
    if starts:
        raise ConfigError(
            f"{starts[0]} does not go with resume: a resumed run goes on with its own networks; leave one of "
            "the two out"
        )


def _resume(lines: list[str], path: Path, warn: Warn, show: _Show) -> Launched:
    with interrupts_wait():
        check_resumable(path, "resume")
        folder = runs.find_run(path, "resume")
        config = compose_resumed(lines, folder / runs.CONFIG)
        check_environment(config)

    with _locked(folder, warn):
        checkpoint, over = _newest_checkpoint(config, path if path.is_file() else folder, warn)
        if over is not None:
            what = "nothing was changed"
            if not path.is_file() and _catch_up(config, folder, checkpoint, warn):
                what = "its last ONNX files, which were missing, were written"
            message = f"nothing to train, and {what}: the run in {folder} is over: {over}"
            return Launched(folder, None, message, checkpoint)

        # the record says how the run was trained: a resume that wrote no checkpoint puts the old one back
        record = runs.read_record(folder)
        runs.write_record(folder, config, lines)
        try:
            outcome = _train(config, folder, checkpoint, show)
        except BaseException:
            runs.restore_record(folder, record)
            raise
        if outcome.last_checkpoint == checkpoint:  # interrupted before an iteration was complete
            runs.restore_record(folder, record)
        return Launched(folder, outcome)


def _newest_checkpoint(config: Config, source: Path, warn: Warn) -> tuple[Path, str | None]:
    """Return the newest good checkpoint, and why there is nothing to train from it (or None)."""
    with interrupts_wait():
        from mappo_unity.runs.checkpoint import newest_good
        from mappo_unity.training.trainer import why_over

    checkpoint, warnings = newest_good(source)
    for warning in warnings:
        warn(warning)
    return checkpoint, why_over(config, checkpoint)


def _catch_up(config: Config, folder: Path, last: Path, warn: Warn) -> bool:
    """Write the last ONNX files of a run that was broken off before them; return whether any were missing."""
    if not config.export_onnx:
        return False

    with interrupts_wait():
        from mappo_unity.policies.export import RunExports
        from mappo_unity.runs.checkpoint_file import step_of

    exports, agent_steps = RunExports(folder, warn, is_resumed=True), step_of(last)
    if not exports.is_behind(agent_steps):
        return False

    exports.finish(last)
    return not exports.is_behind(agent_steps)


@contextmanager
def _locked(folder: Path, warn: Warn) -> Iterator[None]:
    with locked(folder) as warning:
        if warning is not None:
            warn(warning)
        yield


def _train(config: Config, folder: Path, checkpoint: Path | None, show: _Show) -> Outcome:
    with interrupts_wait():
        from mappo_unity.training.trainer import train

    return train(config, folder, checkpoint, show.after_iteration, show.console)
