"""mappo-eval: play episodes, or matches, with a trained policy."""

from __future__ import annotations

from typing import Any

from mappo_unity.config.schema import EvalConfig
from mappo_unity.signals import interrupts_end


def help_text() -> str:
    """Return the text of --help."""
    from mappo_unity.cli.help import eval_help

    return eval_help(EvalConfig)


def run(lines: list[str]) -> int:
    """Play; print a table and one line of JSON; return the exit code."""
    with interrupts_end("mappo-eval"):
        from mappo_unity.config.compose import compose_plain
        from mappo_unity.config.plain_options import take_parameters
        from mappo_unity.policies.first_checks import check_evaluation

        params, lines = take_parameters(lines)
        config = compose_plain(lines, EvalConfig)
        check_evaluation(config, params)
        options = vars(config)
        where = options.pop("run")

        # torch comes only now: mistakes in the options are told at once
        from mappo_unity.policies.evaluate import evaluate

    result: dict[str, Any] = evaluate(where, **options, params=params)
    from mappo_unity.cli import summaries

    summaries.console().print(summaries.eval_table(result))
    print(summaries.json_line(result))
    return 0
