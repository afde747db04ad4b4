"""When checkpoints are written: regularly, when the policy is the best so far, and when a run breaks off."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from mappo_unity.config.overrides import shell_argument
from mappo_unity.config.schema import Config
from mappo_unity.errors import ConfigError
from mappo_unity.policies.export import RunExports
from mappo_unity.runs import checkpoint
from mappo_unity.training.match_series import MISSING
from mappo_unity.training.run_state import RunState


class CheckpointSaver:
    """Keep the last complete iteration of a run, and write it when it is time.

    Args:
        cfg: the run's options.
        folder: the run's folder.
        state: of the run.
        exports: told when the best checkpoint changed; None: no exports.
        last: the checkpoint that is resumed.
    """

    def __init__(
        self, cfg: Config, folder: Path, state: RunState, exports: RunExports | None, last: Path | None
    ) -> None:
        self._cfg, self._folder, self._state, self._exports = cfg, folder, state, exports
        self.last = last
        self._resumed = last is not None
        self._has_exported = False
        self._saved_iteration = state.iteration if last else None
        self._complete: dict[str, Any] | None = None  # the last iteration that this process completed

    @property
    def best(self) -> Path | None:
        """The best checkpoint, where there is one."""
        path = self._folder / checkpoint.FOLDER / checkpoint.BEST
        return path if path.exists() else None

    def complete(self) -> None:
        """Keep the state of the iteration that is just complete, but for a series of matches that is due."""
        state = self._state
        self._complete = state.state_dict()
        self._complete["matches"][MISSING] = state.matches.is_due(state.agent_steps)

    def complete_matches(self) -> None:
        """Take the series of matches that was played after `complete` into what is kept."""
        assert self._complete is not None
        self._complete["matches"] = self._state.matches.state_dict()

    def add_series(self) -> None:
        """Write the checkpoint that is resumed once more, with the series of matches that it lacked."""
        assert self.last is not None
        self._complete, self._saved_iteration = checkpoint.load(self.last), None
        self.complete_matches()
        self.save(is_regular=False)

    def save_if_due(self, won: bool) -> None:
        """Save after the first iteration, at the regular interval, or where these weights won a series.

        Args:
            won: the iteration's series of matches made these weights the best.
        """
        state = self._state
        is_over = state.agent_steps - state.saved_at >= self._cfg.checkpoint_interval
        if won or is_over or self.last is None:
            self.save()

    def save(self, is_regular: bool = True) -> None:
        """Write a checkpoint of the last complete iteration, unless there is one.

        Args:
            is_regular: the next ones are to come at intervals from this one.

        Raises:
            CheckpointError: it cannot be written.
        """
        complete, state = self._complete, self._state
        if complete is None or complete["iteration"] == self._saved_iteration:
            return

        best = state.is_best()
        if best:
            state.best_score = max(state.best_score, state.score())
        # the first one comes early, and one of an interruption at any time: they are not part of the rhythm
        is_due = complete["agent_steps"] - state.saved_at >= self._cfg.checkpoint_interval
        if self.last is not None and (is_regular or is_due):
            state.saved_at = complete["agent_steps"]
        # both are known only now, and a resumed run needs them
        complete |= {"best_score": state.best_score, "saved_at": state.saved_at}

        steps, keep = complete["agent_steps"], self._cfg.keep_checkpoints
        self.last = checkpoint.save_in(self._folder, steps, complete, keep, best)
        self._saved_iteration = complete["iteration"]

        if best and self._exports is not None:
            self._exports.best_changed()

    def finish(self) -> None:
        """Save what is not saved yet, and export the best and the last checkpoint."""
        # a run that is interrupted here goes on in its rhythm when it is resumed
        self.save(is_regular=False)
        self.export()

    def export(self) -> None:
        """Export the best and the last checkpoint, which are written; not again what was broken off."""
        if self._exports is not None and not self._has_exported:
            self._has_exported = True
            self._exports.finish(self.last)

    def rescue(self, say: Callable[[str], None]) -> None:
        """Save the last complete iteration before an error or a second signal ends the run; say where."""
        try:
            self.save(is_regular=False)
        except (ConfigError, OSError) as error:  # which must not hide the one that ends the run
            say(str(error))
            return

        if self._complete is not None:
            iteration, steps = self._complete["iteration"], self._complete["agent_steps"]
            say(
                f"saved the last complete iteration, {iteration} ({steps:,} steps): {self.last}; "
                f"resume with: mappo-train {shell_argument('resume', self._folder)}"
            )
        elif not self._resumed:
            say("no iteration was complete: there is nothing to resume")
