"""What findings are drawn from: a run's options, its metrics and its survey; whether its return has risen."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from mappo_unity.diagnosis.survey_file import read_survey
from mappo_unity.reports.reading import Run
from mappo_unity.runs.metrics_csv import STEP

_WIN_RATE = "win_rate_vs_random"
_RISE = 5.0  # standard errors by which a return must have risen: many windows are compared
_ONE_ACTION = 0.95  # of the decisions

Facts = dict[str, Any]
"""What the batches of one policy name held (`PolicySurvey.facts`)."""


@dataclass(frozen=True)
class Finding:
    """Something that keeps a run from learning.

    Attributes: `kind`, a word for it; `text`, what is the matter; `evidence`, what was seen; `cure`, what to
    do about it, an option where there is one.
    """

    kind: str
    text: str
    evidence: str
    cure: str

    def as_record(self) -> dict[str, str]:
        """Return it as a report's page takes it."""
        return {"text": self.text, "evidence": self.evidence, "cure": self.cure}


@dataclass(frozen=True)
class Evidence:
    """A run, and what its batches held by policy name; empty for runs of versions that did not look."""

    run: Run
    survey: dict[str, Any]

    @classmethod
    def of(cls, run: Run) -> Evidence:
        """Return what a run's folder holds."""
        return cls(run, read_survey(run.folder))

    # --- options

    def option(self, key: str, policy: str | None = None) -> str:
        """Return an option's value as a text; with a policy name, as ``behaviors.NAME`` has it."""
        options = self.run.options
        return options.get(f"behaviors.{policy}.{key}", options.get(key, ""))

    def number(self, key: str, policy: str | None = None) -> float:
        """Return an option that is a number; NaN for null."""
        try:
            return float(self.option(key, policy).replace("_", ""))
        except ValueError:
            return math.nan

    # --- metrics

    def column(self, name: str, policy: str | None = None) -> np.ndarray:
        """Return a metric's numbers, float64 [rows that have one]; of a policy where the run has several."""
        columns = self.run.columns
        values = columns.get(f"{policy}/{name}", columns.get(name, np.empty(0)))
        return values[np.isfinite(values)]

    def is_frozen(self, policy: str) -> bool:
        """Whether a policy only plays, in the newest iteration."""
        return bool(self.column(f"{policy}/frozen")[-1:].any())

    @property
    def updates(self) -> int:
        """How many iterations the run has done."""
        return len(self.column(STEP))

    @property
    def decisions(self) -> int:
        """How many decisions its agents have made."""
        steps = self.column(STEP)
        return int(steps[-1]) if len(steps) else 0

    @cached_property
    def share_done(self) -> float:
        """The share of max_steps that is done."""
        return self.decisions / self.number("max_steps")

    @property
    def is_judged(self) -> bool:
        """Whether the run is so far that learning may be expected: half of its steps, twenty iterations."""
        return self.share_done >= 0.5 and self.updates >= 20

    @cached_property
    def returns(self) -> tuple[float, float, float]:
        """The mean return of the first full window, that of the last rows, and by how much one must differ.

        All are NaN before there are two full windows.
        """
        value, spread = self.run.columns.get("return_mean"), self.run.columns.get("return_std")
        ended = self.run.columns.get("episodes")
        if value is None or spread is None or ended is None:
            return math.nan, math.nan, math.nan

        window = self.number("log.return_window")
        full = np.isfinite(value) & (ended >= window)
        if full.sum() < 2:
            return math.nan, math.nan, math.nan
        value, spread, ended = value[full], spread[full], ended[full]
        late = slice(-max(1, len(value) // 5), None)

        # The first window's error is that of the widest one up to half of the run: others may have met a
        # reward by luck that it did not, while returns that rise spread ever wider.
        first_error = spread[: (len(spread) + 1) // 2].max() / math.sqrt(window)
        last_error = spread[late].max() / math.sqrt(max(window, ended[-1] - ended[late][0]))
        least = _RISE * float(max(first_error, last_error))
        return float(value[0]), float(value[late].mean()), max(least, 1e-6)

    @cached_property
    def has_risen(self) -> bool:
        """Whether the return, or with two sides the share won against random, is above where it began.

        A run that began with a trained policy, that went on to another lesson, or that came to its goal, has
        nothing to show here.
        """
        begun_with = [v for key, v in self.run.options.items() if key.rpartition(".")[2] == "init_from"]
        if any(value not in ("", "null") for value in begun_with):
            return True
        if any(np.ptp(self.column(name)) > 0 for name in self.run.metrics if name.startswith("lesson/")):
            return True

        won = self.column(_WIN_RATE)
        if len(won):
            return bool(won[-3:].mean() > 0.6)

        first, last, least = self.returns
        return last - first > least

    @cached_property
    def has_fallen(self) -> bool:
        """Whether the return is below where it began."""
        first, last, least = self.returns
        return first - last > least


def leaves_one_action(facts: Facts) -> bool:
    """Return whether masks leave one action in nearly all decisions."""
    return (facts.get("one_action") or 0.0) >= _ONE_ACTION


def amount(value: float) -> str:
    """Return a number for a sentence."""
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"
