"""mappo-train: train, resume or sweep."""

from __future__ import annotations

import signal
import sys
from pathlib import Path

from mappo_unity.config.schema import Config
from mappo_unity.signals import interrupts_wait

_MOST_ROLLED_BACK = 4


def help_text() -> str:
    """Return the text of --help."""
    from mappo_unity.cli.help import train_help

    return train_help(Config)


def run(lines: list[str]) -> int:
    """Train, resume or sweep as the command line says; return the exit code."""
    from mappo_unity.config.options_file import take_file
    from mappo_unity.config.renamed import rename_lines
    from mappo_unity.config.text_lines import literal_lines

    lines = rename_lines(lines, lambda text: print(f"mappo-train: {text}", file=sys.stderr))

    options = [line for line in lines if line not in ("-m", "--multirun")]
    is_sweep = len(options) < len(lines)

    lines, file = take_file(literal_lines(options, Config, is_sweep))

    return _sweep(lines, file) if is_sweep else _train(lines, file)


def _train(lines: list[str], file: Path | None) -> int:
    with interrupts_wait():
        from mappo_unity.training.launch import launch

    launched = launch(lines, file, warn=lambda text: print(f"mappo-train: {text}", file=sys.stderr))
    if launched.outcome is None:
        print(launched.message)
        return 0

    from mappo_unity.cli.summaries import run_summary
    from mappo_unity.config.overrides import shell_argument

    outcome, folder = launched.outcome, launched.folder
    print("\n".join(run_summary(outcome, folder)), flush=True)

    if outcome.signal is None:
        return _MOST_ROLLED_BACK if outcome.status == "diverged" else 0

    name = signal.Signals(outcome.signal).name
    print(
        f"mappo-train: ended by {name}; checkpoint {outcome.last_checkpoint}; "
        f"resume with: mappo-train {shell_argument('resume', folder)}",
        file=sys.stderr,
    )
    # as shells report a process that a signal ended
    return 128 + outcome.signal


def _sweep(lines: list[str], file: Path | None) -> int:
    from mappo_unity.cli import summaries
    from mappo_unity.training.sweep import run_sweep

    result = run_sweep(lines, file)
    # the file before the table: a reader of the output that has gone must not cost it
    summaries.write_csv(result)

    console = summaries.console()
    console.print(summaries.sweep_table(result))
    for line in summaries.sweep_summary(result):
        console.print(line, soft_wrap=True, highlight=False, markup=False)

    for job in result.jobs:
        if job.error:
            print(f"mappo-train: job {job.job} failed: {job.error}", file=sys.stderr)
    if result.error:
        print(f"mappo-train: the sweep broke off: {result.error}", file=sys.stderr)

    return result.exit_code
