"""Write a demonstration while a BaseEnv is played.

Episodes of all agents stand in the file one whole episode after the other, so that every reader sees
consecutive records of one agent. A record holds an observation and the action taken at it: the pairs that
ML-Agents' own loader makes. The file appears under its name only when it is complete.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from mlagents_envs.base_env import ActionTuple, BehaviorSpec, DecisionSteps, TerminalSteps

from mappo_unity.errors import ConfigError
from mappo_unity.protocol.decode import ActionEncoder
from mappo_unity.protocol.demos.demo_file import BEHAVIOR_AT, delimited, header
from mappo_unity.protocol.encode import BehaviorEncoder

_ACTION = b"\x12"
"""Tag of the action in an AgentInfoActionPairProto; that of the agent is the one of a list's entries."""


@dataclass
class _Episode:
    """What has been played of an agent's episode: an entry a decision."""

    records: list[bytes] = field(default_factory=list)
    rewards: list[float] = field(default_factory=list)
    """What came with each."""
    action: bytes = b""
    """The newest, with its tag."""
    last: DecisionSteps | None = None
    """The newest decision."""


class DemoWriter:
    """Write the episodes of a behavior's agents into a file, until `close`.

    An episode that has not ended when the recording does ends as interrupted, at the last decision requested.

    Args:
        path: the file; one that is there is replaced (`recording_env.recording_files` refuses it).
        behavior: name to write into it.
        spec: sensors and actions.

    Raises:
        ConfigError: the file cannot be written (also later: a full disk).

    Attributes: `episodes` and `decisions`, how many were written.
    """

    def __init__(self, path: Path, behavior: str, spec: BehaviorSpec) -> None:
        self.path, self.episodes, self.decisions = path, 0, 0
        self._info, self._action = BehaviorEncoder(behavior, spec), ActionEncoder(spec)
        self._no_decision, self._no_end = DecisionSteps.empty(spec), TerminalSteps.empty(spec)
        self._running: dict[int, _Episode] = {}
        self._records, self._total_return = 0, 0.0

        # Hidden, and no suffix of a recording's: nobody may take it for one.
        self._part = path.with_name(f".{path.stem[:40]}.{os.getpid()}.part")
        with _told(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = self._part.open("wb")
            self._file.write(bytes(BEHAVIOR_AT) + delimited(self._info.brain_parameters()))

    def record(self, decision: DecisionSteps, terminal: TerminalSteps, action: ActionTuple) -> None:
        """Take one result of `get_steps`, and the actions for its `decision`, row by row."""
        for row, agent in enumerate(terminal.agent_id.tolist()):
            if agent in self._running:
                self._end(self._running.pop(agent), _terminal_row(terminal, row))

        actions = self._action.encode(action) if len(decision) else b""
        width = len(actions) // max(1, len(decision))
        for row, agent in enumerate(decision.agent_id.tolist()):
            episode = self._running.setdefault(agent, _Episode())
            episode.last = _decision_row(decision, row)
            # of an entry of a list only the tag is another than that of the pair's second field
            episode.action = _ACTION + actions[row * width + 1 : (row + 1) * width]
            info = self._info.encode(episode.last, self._no_end)
            episode.records.append(info + episode.action)
            episode.rewards.append(_reward(episode.last))

    def cut(self) -> None:
        """End the running episodes where they are, as interrupted."""
        for episode in self._running.values():
            # What followed the newest decision is not known: it becomes the end.
            episode.records.pop()
            episode.rewards.pop()
            if episode.last is not None:
                self._end(episode, _as_end(episode.last))
        self._running.clear()

    def close(self) -> None:
        """End the recording; no file is made of no decision."""
        if self._file.closed:
            return

        with _told(self.path):
            try:
                self.cut()
                mean = self._total_return / max(1, self.episodes)
                self._file.seek(0)
                self._file.write(header(self.path.stem, self._records, self.episodes, mean))
                self._file.close()
                if self.episodes:
                    os.replace(self._part, self.path)
            finally:
                self._file.close()
                self._part.unlink(missing_ok=True)

    def _end(self, episode: _Episode, end: TerminalSteps) -> None:
        """Write an episode, unless it had no decision."""
        if not episode.records:
            return

        # The end has no action, but ML-Agents' loader wants one in every record except the file's last.
        last = self._info.encode(self._no_decision, end) + episode.action
        with _told(self.path):
            self._file.write(b"".join(delimited(record) for record in (*episode.records, last)))
        self._records += len(episode.records) + 1
        self.decisions += len(episode.records)
        self.episodes += 1
        # What came with the first decision was earned before it.
        self._total_return += sum(episode.rewards[1:]) + _reward(end)


def _decision_row(steps: DecisionSteps, row: int) -> DecisionSteps:
    """Return one agent's decision; copied, since environments may use their arrays again."""
    one = slice(row, row + 1)
    masks = None if steps.action_mask is None else [np.array(mask[one]) for mask in steps.action_mask]
    return DecisionSteps(
        [np.array(obs[one]) for obs in steps.obs],
        np.array(steps.reward[one]),
        np.array(steps.agent_id[one]),
        masks,
        np.array(steps.group_id[one]),
        np.array(steps.group_reward[one]),
    )


def _terminal_row(steps: TerminalSteps, row: int) -> TerminalSteps:
    """Return one agent's end."""
    one = slice(row, row + 1)
    return TerminalSteps(
        [obs[one] for obs in steps.obs],
        steps.reward[one],
        steps.interrupted[one],
        steps.agent_id[one],
        steps.group_id[one],
        steps.group_reward[one],
    )


def _as_end(steps: DecisionSteps) -> TerminalSteps:
    """Return an interrupted end with what a decision saw and earned."""
    interrupted = np.ones(len(steps), bool)
    return TerminalSteps(
        steps.obs, steps.reward, interrupted, steps.agent_id, steps.group_id, steps.group_reward
    )


def _reward(steps: DecisionSteps | TerminalSteps) -> float:
    """Return what the only agent of these steps earned."""
    return float(steps.reward[0]) + float(steps.group_reward[0])


@contextmanager
def _told(path: Path) -> Iterator[None]:
    """Tell what kept a recording from being written in one line."""
    try:
        yield
    except OSError as error:
        raise ConfigError(f"recording {path} cannot be written: {error.strerror or error}") from error
