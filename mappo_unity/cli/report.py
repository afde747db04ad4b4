"""mappo-report: one page of HTML about runs."""

from __future__ import annotations

from pathlib import Path

from mappo_unity.config.schema import ReportConfig


def help_text() -> str:
    """Return the text of --help."""
    from mappo_unity.cli.help import report_help

    return report_help(ReportConfig)


def run(lines: list[str]) -> int:
    """Write the page; print where it is; return the exit code."""
    from mappo_unity.config.compose import compose_plain
    from mappo_unity.config.plain_options import take_words
    from mappo_unity.diagnosis.diagnose import records
    from mappo_unity.reports.writing import write_report

    options = compose_plain(take_words(lines, ReportConfig, "runs"), ReportConfig)
    out, count = write_report(options.runs, Path(options.out) if options.out else None, records)
    size = out.stat().st_size
    amount = f"{size / 1e6:.1f} MB" if size >= 1e5 else f"{size / 1e3:.0f} kB"
    print(f"{out}: {count} run{'s' if count > 1 else ''}, {amount}")
    return 0
