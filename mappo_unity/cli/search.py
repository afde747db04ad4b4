"""mappo-search: look for good options."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

from mappo_unity.config.schema import Config, SearchConfig
from mappo_unity.signals import interrupts_end, interrupts_wait

if TYPE_CHECKING:
    from rich.table import Table

    from mappo_unity.training.search.checks import SearchPlan
    from mappo_unity.training.search.table import Row


def help_text() -> str:
    """Return the text of --help."""
    from mappo_unity.cli.help import search_help

    return search_help(SearchConfig)


def run(lines: list[str]) -> int:
    """Search; print a line for each trial, the table and the best command line; return the exit code."""
    with interrupts_end("mappo-search"):
        plan = _plan(lines)

    with interrupts_wait():
        from mappo_unity.cli import summaries
        from mappo_unity.training.search.driver import run_search
        from mappo_unity.training.search.table import TRIALS, best_command

    def told(number: int, rows: list[Row]) -> None:
        print(_trial_line(number, rows, plan), flush=True)

    if plan.preset is None:
        print("the options as they are without a search lie outside the space: no trial has them", flush=True)
    result = run_search(plan, told)

    summaries.console().print(_table(result.rows, plan))
    print(f"{plan.folder / TRIALS}")
    command = best_command(result.rows, plan)
    print(f"best: {command}" if command else "no trial is complete", flush=True)
    if result.signal is not None:
        print("mappo-search: interrupted; the same command goes on with the search", file=sys.stderr)
    return result.exit_code


def _plan(lines: list[str]) -> SearchPlan:
    from mappo_unity.config.compose import compose_plain
    from mappo_unity.config.options_file import take_file
    from mappo_unity.config.renamed import rename_lines
    from mappo_unity.config.text_lines import literal_lines
    from mappo_unity.training.search.checks import check_search, split_lines

    lines = rename_lines(lines, lambda text: print(f"mappo-search: {text}", file=sys.stderr))
    own, lines = split_lines(lines)
    lines, file = take_file(literal_lines(lines, Config))
    return check_search(compose_plain(own, SearchConfig), lines, file)


def _trial_line(number: int, rows: list[Row], plan: SearchPlan) -> str:
    from mappo_unity.cli.summaries import show_number

    row = next(row for row in rows if row.number == number)
    ended = sum(row.status != "unfinished" for row in rows)
    value = f"{_what(plan)} {show_number(_value(row))}" if row.value is not None else row.error or ""
    best = (
        f"; best {show_number(_value(rows[0]))} (trial {rows[0].number})" if rows[0].value is not None else ""
    )
    return f"{ended}/{plan.options.trials} trial {number} {row.status} {value}{best}  {' '.join(row.lines)}"


def _table(rows: list[Row], plan: SearchPlan) -> Table:
    from rich.table import Table

    from mappo_unity.cli.summaries import short_text, show_number

    table = Table(title="Trials, best first")
    table.add_column("trial", justify="right")
    for key in plan.space:
        table.add_column(key)
    table.add_column(_what(plan), justify="right")
    for name in ("return_mean", "agent_steps", "wall_s"):
        table.add_column(name, justify="right")
    table.add_column("status")
    table.add_column("error", overflow="fold")

    for row in rows:
        options = dict(line.split("=", 1) for line in row.lines)
        values = [short_text(options.get(key, "")) for key in plan.space]
        figures = map(show_number, (_value(row), row.return_mean, row.agent_steps, row.wall_s))
        table.add_row(str(row.number), *values, *figures, row.status, row.error or "")
    return table


def _value(row: Row) -> float | None:
    """Return the value, decisions without decimals."""
    return int(row.value) if row.value is not None and row.value.is_integer() else row.value


def _what(plan: SearchPlan) -> str:
    goal = f"{plan.options.goal:g}" if plan.options.goal is not None else ""
    words = {
        "final_return": "final return",
        "decisions": f"decisions to {goal}",
        "time": f"seconds to {goal}",
    }
    return words[plan.objective.name]
