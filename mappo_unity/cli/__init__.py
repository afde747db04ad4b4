"""The commands: the only place that prints. Heavy imports happen inside them.

Exit codes: 0 done, 1 an error of ours (with its traceback) or a failed job of a sweep, 2 a mistake
in the options, 3 an environment that failed for good (a checkpoint is written first), 4 a run that
ended but most of whose updates were rolled back, 130 and 143 ended by SIGINT and SIGTERM.
"""

from __future__ import annotations

import errno
import io
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from mappo_unity.config.schema import (
    Config,
    ConfigError,
    EnvironmentFailure,
    EvalConfig,
    ExportConfig,
    PlayConfig,
)
from mappo_unity.interrupts import interrupts_end, interrupts_wait

_MOST_ROLLED_BACK = 4
_SIGNALS = {2: "SIGINT", 15: "SIGTERM"}
_NOT_OURS = (errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO)
"""What a file system refuses for reasons of its own."""


def train_main(arguments: list[str] | None = None) -> int:
    """Run mappo-train: train, continue or sweep; return the exit code."""
    return _run_command("mappo-train", _train_command, _train_help, arguments)


def eval_main(arguments: list[str] | None = None) -> int:
    """Run mappo-eval: play episodes with a trained policy; return the exit code."""
    return _run_command("mappo-eval", _eval_command, _eval_help, arguments)


def play_main(arguments: list[str] | None = None) -> int:
    """Run mappo-play: show a policy in its scene; return the exit code."""
    return _run_command("mappo-play", _play_command, _play_help, arguments)


def export_main(arguments: list[str] | None = None) -> int:
    """Run mappo-export: write a trained policy as ONNX files; return the exit code."""
    return _run_command("mappo-export", _export_command, _export_help, arguments)


def player_main(arguments: list[str] | None = None) -> int:
    """Run mappo-player: serve a scene as a Unity player; return the exit code."""
    return _run_command("mappo-player", _player_command, _player_help, arguments)


def doctor_main(arguments: list[str] | None = None) -> int:
    """Run mappo-doctor: look for what keeps a player or an environment from working; return the exit code."""
    return _run_command("mappo-doctor", _doctor_command, _doctor_help, arguments)


def _run_command(
    name: str, command: Callable[[list[str]], int], help_text: Callable[[], str], arguments: list[str] | None
) -> int:
    lines = sys.argv[1:] if arguments is None else arguments
    if isinstance(sys.stdout, io.TextIOWrapper):  # a path in letters that a terminal lacks must end no run
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        if any(line in ("--help", "-h") for line in lines):
            print(help_text())
            code = 0
        elif "--version" in lines:
            from mappo_unity import __version__

            print(f"{name} {__version__}")
            code = 0
        else:
            code = command(lines)
        if sys.stdout is not None:  # closed by `>&-`
            sys.stdout.flush()
        return code
    except BrokenPipeError:  # the reader of our output has gone, as in `mappo-eval ... | head -1`
        _drop_output()
        return 141
    except ConfigError as error:
        print(f"{name}: {error}", *error.details, sep="\n", file=sys.stderr)
        return 2
    except EnvironmentFailure as error:
        print(f"{name}: {error}", *error.details, sep="\n", file=sys.stderr)
        return 3
    except KeyboardInterrupt as error:
        print(f"{name}: interrupted", file=sys.stderr)
        return 128 + int(getattr(error, "signal", 2))
    except OSError as error:  # what nobody below knew the option of
        if error.errno not in _NOT_OURS:
            raise
        _drop_output()
        print(f"{name}: {error.filename or 'its output'}: {error.strerror}", file=sys.stderr)
        return 2


def _drop_output() -> None:
    """Let what is still to be written to standard output go nowhere, also when Python ends."""
    with suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _train_help() -> str:
    from mappo_unity.cli.help import train_help

    return train_help(Config)


def _eval_help() -> str:
    from mappo_unity.cli.help import eval_help

    return eval_help(EvalConfig)


def _play_help() -> str:
    from mappo_unity.cli.help import play_help

    return play_help(PlayConfig)


def _export_help() -> str:
    from mappo_unity.cli.help import export_help

    return export_help(ExportConfig)


def _player_help() -> str:
    from mappo_unity.protocol.player_options import help_text

    return help_text()


def _player_command(lines: list[str]) -> int:
    with interrupts_end("mappo-player"):
        from mappo_unity.protocol.serve import main

    return main(lines)


def _doctor_help() -> str:
    from mappo_unity.cli.doctor import help_text

    return help_text()


def _doctor_command(lines: list[str]) -> int:
    with interrupts_end("mappo-doctor"):
        from mappo_unity.cli.doctor import diagnose

    return diagnose(lines, print)


def _train_command(lines: list[str]) -> int:
    from mappo_unity.config.options_file import take_file
    from mappo_unity.config.overrides import given
    from mappo_unity.config.text_lines import literal_lines

    options = [line for line in lines if line not in ("-m", "--multirun")]
    is_sweep = len(options) < len(lines)
    lines, file = take_file(literal_lines(options, Config, is_sweep))
    if is_sweep:
        return _sweep(lines, file)
    resume = given(lines, "resume")
    if resume == "":
        raise ConfigError("resume= is empty: it must name a run folder or a checkpoint file")
    return _train_anew(lines, file) if resume is None else _train_on(lines, Path(str(resume)))


def _train_anew(lines: list[str], file: Path | None) -> int:
    with interrupts_wait():
        from mappo_unity.config.compose import check_effect, compose_config
        from mappo_unity.config.overrides import given
        from mappo_unity.policies.first_checks import check_environment
        from mappo_unity.runs import folder as runs

        composed = compose_config(lines, file=file)
        check_effect(lines, [composed.config])
        check_environment(composed.config)
    folder = runs.create_folder(composed.run_dir, exact=given(lines, "hydra.run.dir") is not None)
    try:
        with _locked(folder.path):
            typed = lines if file is None else [f"--config={file}", *lines]
            runs.write_record(folder.path, composed.config, typed)
            return _train(composed.config, folder.path, None)
    except (ConfigError, KeyboardInterrupt) as error:
        runs.discard_folder(folder, error)
        raise


def _train_on(lines: list[str], path: Path) -> int:
    with interrupts_wait():
        from mappo_unity.config.compose import compose_resumed
        from mappo_unity.policies.first_checks import check_environment
        from mappo_unity.policies.policy_files import check_resumable
        from mappo_unity.runs import folder as runs

        check_resumable(path, "resume")
        folder = runs.find_run(path, "resume")
        config = compose_resumed(lines, folder / runs.CONFIG)
        check_environment(config)
    with _locked(folder):
        return _train_locked(config, folder, path if path.is_file() else folder, lines)


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    from mappo_unity.runs.lock import locked

    with locked(folder) as warning:
        if warning is not None:
            print(f"mappo-train: {warning}", file=sys.stderr)
        yield


def _train_locked(config: Config, folder: Path, source: Path, lines: list[str]) -> int:
    from mappo_unity.runs import folder as runs
    from mappo_unity.runs.checkpoint import newest_good

    checkpoint, warnings = newest_good(source)
    for warning in warnings:
        print(f"mappo-train: {warning}", file=sys.stderr)
    with interrupts_wait():
        from mappo_unity.training.trainer import why_over

        reason = why_over(config, checkpoint)
    if reason is not None:
        print(f"nothing to train, and nothing was changed: the run in {folder} is over: {reason}")
        return 0
    record = runs.read_record(folder)
    runs.write_record(folder, config, lines)
    try:
        return _train(config, folder, checkpoint)
    except BaseException:
        runs.restore_record(folder, record)
        raise


def _train(config: Config, folder: Path, checkpoint: Path | None) -> int:
    with interrupts_wait():
        from mappo_unity.training.trainer import train

    outcome = train(config, folder, checkpoint)
    from mappo_unity.cli.report import run_summary
    from mappo_unity.config.overrides import shell_argument

    print("\n".join(run_summary(outcome, folder)), flush=True)
    if outcome.signal is None:
        return _MOST_ROLLED_BACK if outcome.status == "diverged" else 0
    name = _SIGNALS.get(outcome.signal, f"signal {outcome.signal}")
    print(
        f"mappo-train: ended by {name}; checkpoint {outcome.last_checkpoint}; "
        f"continue with: mappo-train {shell_argument('resume', folder)}",
        file=sys.stderr,
    )
    return 128 + outcome.signal


def _sweep(lines: list[str], file: Path | None) -> int:
    from mappo_unity.cli import report
    from mappo_unity.training.sweep import run_sweep

    result = run_sweep(lines, file)
    report.write_csv(result)
    console = report.console()
    console.print(report.sweep_table(result))
    console.print(f"sweep folder: {result.folder}", soft_wrap=True, highlight=False)
    for job in result.jobs:
        if job.error:
            print(f"mappo-train: job {job.job} failed: {job.error}", file=sys.stderr)
    if result.error:
        print(f"mappo-train: the sweep broke off: {result.error}", file=sys.stderr)
    return result.exit_code


def _eval_command(lines: list[str]) -> int:
    with interrupts_end("mappo-eval"):
        from mappo_unity.config.compose import compose_plain
        from mappo_unity.policies.first_checks import check_evaluation

        config = compose_plain(lines, EvalConfig)
        check_evaluation(config)
        options = vars(config)
        run = Path(options.pop("run"))
        from mappo_unity.policies.evaluate import evaluate

    result: dict[str, Any] = evaluate(run, **options)
    from mappo_unity.cli import report

    report.console().print(report.eval_table(result))
    print(report.json_line(result))
    return 0


def _play_command(lines: list[str]) -> int:
    with interrupts_end("mappo-play"):
        from mappo_unity.config.compose import compose_plain
        from mappo_unity.policies.first_checks import check_film
        from mappo_unity.policies.screens import check_screen

        options = compose_plain(lines, PlayConfig)
        check_screen(options)
        check_film(options)
        from mappo_unity.cli.report import play_line
        from mappo_unity.policies.film import play

    print(play_line(play(options)))
    return 0


def _export_command(lines: list[str]) -> int:
    with interrupts_end("mappo-export"):
        from mappo_unity.config.compose import compose_plain
        from mappo_unity.policies.first_checks import check_export
        from mappo_unity.policies.policy_files import choose_checkpoint

        options = compose_plain(lines, ExportConfig)
        check_export(options)
        from mappo_unity.policies.export import export_checkpoint

    checkpoint = choose_checkpoint(Path(options.run))
    for file in export_checkpoint(checkpoint, Path(options.out) if options.out else None):
        print(
            f"{file.path}: {file.policy} after {file.agent_steps:,} agent steps; plays as {checkpoint} does "
            f"(on {file.rows} observations: actions to {file.error:.1e}, samples in distribution)"
        )
    return 0
