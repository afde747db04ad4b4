"""The trials of a search, kept by Optuna in a file of the search's folder. The only module that knows Optuna.

One process asks, reports and tells; those that train never open the file.
"""

from __future__ import annotations

import logging
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import optuna
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend, JournalFileOpenLock
from optuna.trial import FrozenTrial, Trial, TrialState

from mappo_unity.config.schema import Pruner, SearchObjective
from mappo_unity.runs.atomic import write_atomically
from mappo_unity.training.search.messages import MARKS, TrialResult
from mappo_unity.training.search.space import Range, to_line

if TYPE_CHECKING:
    from mappo_unity.training.search.checks import SearchPlan

JOURNAL = "journal.log"
_NAME = "mappo-search"
_STARTUP = 10  # random trials before the sampler builds on what it knows, at most; a quarter of all
_LOST = "lost"  # how often a trial's process died
_STATES = {"complete": TrialState.COMPLETE, "pruned": TrialState.PRUNED, "failed": TrialState.FAIL}


class SearchStudy:
    """Ask for trials, report on them, tell what came of them.

    Args:
        plan: the search.
    """

    def __init__(self, plan: SearchPlan) -> None:
        self._space, trials = plan.space, plan.options.trials
        self._sign = 1.0 if plan.objective is SearchObjective.final_return else -1.0
        optuna.logging.set_verbosity(logging.WARNING)

        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # "experimental"
            self._study = optuna.create_study(
                storage=_storage(plan.folder / JOURNAL),
                study_name=_NAME,
                load_if_exists=True,
                direction="maximize" if self._sign > 0 else "minimize",
            )
            # a search that goes on must not draw the same numbers again
            seed = plan.first_seed + 1000 * len(self._study.trials)
            startup = max(2, min(_STARTUP, trials // 4))
            self._study.sampler = optuna.samplers.TPESampler(
                seed=seed, n_startup_trials=startup, constant_liar=True
            )
            self._study.pruner = _pruner(plan.options.pruner)

        # the search cannot end worse than what it started from
        if plan.preset is not None and not self._study.trials:
            self._study.enqueue_trial(plan.preset)

    @property
    def trials(self) -> list[FrozenTrial]:
        """All trials that were asked for, by number."""
        return [
            trial for trial in self._study.get_trials(deepcopy=False) if trial.state != TrialState.WAITING
        ]

    def unfinished(self) -> list[Trial]:
        """Return the trials of a search that broke off, to be taken up again."""
        running = [trial for trial in self.trials if trial.state == TrialState.RUNNING]
        return [Trial(self._study, trial._trial_id) for trial in running]

    def ask(self) -> Trial:
        """Return a new trial, with a value for each option of the space."""
        return self._study.ask()

    def suggest(self, trial: Trial) -> list[str]:
        """Return a trial's options as lines of the command line; the same ones each time."""
        return [to_line(key, self._value(trial, key)) for key in self._space]

    def report(self, trial: Trial, marks: Sequence[tuple[int, float]]) -> bool:
        """Take the mean return at some marks of a trial's first run; return whether the trial should end."""
        known = self._study.get_trials(deepcopy=False)[trial.number].intermediate_values
        for mark, value in marks:
            if mark not in known:  # a trial that was taken up again passes its marks twice
                trial.report(self._sign * value, mark)
        return bool(marks) and trial.should_prune()

    def tell(self, trial: Trial, result: TrialResult) -> None:
        """Take what came of a trial."""
        for name, value in (
            ("return_mean", result.return_mean),
            ("agent_steps", result.agent_steps),
            ("wall_s", result.wall_s),
            ("values", result.values),
            ("error", result.error),
        ):
            trial.set_user_attr(name, value)

        state = _STATES[result.status]
        self._study.tell(trial, result.value if state is TrialState.COMPLETE else None, state=state)

    def count_lost(self, trial: Trial) -> int:
        """Count that a trial's process died; return how often that has happened."""
        lost = int(trial.user_attrs.get(_LOST, 0)) + 1
        trial.set_user_attr(_LOST, lost)
        return lost

    def _value(self, trial: Trial, key: str) -> Any:
        entry = self._space[key]
        if not isinstance(entry, Range):
            return trial.suggest_categorical(key, entry.values)
        if entry.whole:
            return trial.suggest_int(key, int(entry.low), int(entry.high), log=entry.log)
        return trial.suggest_float(key, entry.low, entry.high, log=entry.log)


def _storage(path: Path) -> JournalStorage:
    """Open the trials' file, without a last line that was cut off by a full disk or a loss of power."""
    if path.is_file():
        data = path.read_bytes()
        whole = data[: data.rfind(b"\n") + 1]
        if whole != data:
            write_atomically(path, whole)

    # a lock that works on every system: symbolic links need a right on Windows
    return JournalStorage(JournalFileBackend(str(path), lock_obj=JournalFileOpenLock(str(path))))


def _pruner(kind: Pruner) -> optuna.pruners.BasePruner:
    if kind is Pruner.median:
        return optuna.pruners.MedianPruner(n_startup_trials=4, n_warmup_steps=MARKS // 2)
    if kind is Pruner.hyperband:
        return optuna.pruners.HyperbandPruner(min_resource=MARKS // 4, max_resource=MARKS)
    return optuna.pruners.NopPruner()
