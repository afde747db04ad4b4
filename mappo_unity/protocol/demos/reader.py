"""Read demonstrations: one file, several, or all of a folder.

Which action was taken at which observation depends on who wrote the file. Unity's recorder writes a record
when the decision is requested, before it is taken: the record holds the action *before* it, and the one taken
stands in the next record. Such files end in a copy of their header (`demo_file`). In files without one, of
older recorders and ours, observation and action of a record belong together.

ML-Agents' loader pairs both kinds in the second way. That the first kind is shifted was measured: in
ExpertPyramid what the agent sees next follows from the action of the next record, and not from the record's
own. Recordings of Hallway and PushBlock have such an end, too, and are taken for shifted because of it; what
is seen in them decides it weakly (Hallway) or not at all.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any
from weakref import WeakValueDictionary

import numpy as np
from mlagents_envs.base_env import BehaviorSpec

from mappo_unity.errors import ConfigError
from mappo_unity.protocol.decode import BehaviorDecoder, MalformedMessage, behavior_spec
from mappo_unity.protocol.demos.demo_file import SUFFIX, DemoFile, parse
from mappo_unity.protocol.demos.demonstration import Demonstration, joined
from mappo_unity.protocol.encode import decode_actions
from mappo_unity.scenes.contract.images import looks_unmarked


def read_demo(path: str | Path) -> Demonstration:
    """Return what a .demo file, or all of them in a folder, hold; see `read_demos`."""
    return read_demos([path])


def read_demos(paths: Sequence[str | Path]) -> Demonstration:
    """Return what .demo files hold, one after the other; a folder stands for its .demo files, sorted.

    Raises:
        ConfigError: nothing is there, a file cannot be read, or they are of different behaviors.
    """
    files = [file for path in paths for file in _files(Path(path))]
    if not files:
        raise ConfigError("no demonstration is named: give a .demo file, several, or a folder of them")

    stats = [file.stat() for file in files]
    key = tuple((file.absolute(), stat.st_mtime_ns, stat.st_size) for file, stat in zip(files, stats))
    demo = _held.get(key)
    if demo is None:
        _held[key] = demo = joined([_read(file) for file in files])
    return demo


_held: WeakValueDictionary[tuple[Any, ...], Demonstration] = WeakValueDictionary()
"""What somebody still holds of what was read: several teachers and sides learn from the same files."""


def _files(path: Path) -> list[Path]:
    if not path.exists():
        raise ConfigError(f"demonstration {path} does not exist: give a {SUFFIX} file, or a folder of them")
    if not path.is_dir():
        return [path]
    files = sorted(path.glob(f"*{SUFFIX}"))
    if not files:
        raise ConfigError(f"folder {path} holds no demonstration: it has no file that ends in {SUFFIX}")
    return files


def _read(path: Path) -> Demonstration:
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ConfigError(f"demonstration {path} cannot be read: {error.strerror}") from error

    file = parse(data, path)
    infos = [record.agent_info for record in file.records]
    if not infos[0].observations:
        raise ConfigError(
            f"demonstration {path} has records without observations: recorders of ML-Agents before 0.12 "
            "wrote them elsewhere; record it again"
        )

    try:
        table = _Table(file, _spec(file))
    except (MalformedMessage, ValueError, IndexError) as error:
        raise ConfigError(f"demonstration {path} is damaged: {error}") from error

    return _paired(path, file, table)


def _spec(file: DemoFile) -> BehaviorSpec:
    """Return the behavior's spec.

    A file does not say which package wrote it: of images that mark nothing the smaller one of the first and
    the last dimension is taken for the channels.
    """
    info = file.records[0].agent_info
    spec = behavior_spec(file.behavior, info)
    if any(looks_unmarked(sensor) for sensor in spec.observation_specs if len(sensor.shape) == 3):
        spec = behavior_spec(file.behavior, info, channels_last=True)
    return spec


class _Table:
    """What all records say, in arrays with a row a record."""

    def __init__(self, file: DemoFile, spec: BehaviorSpec) -> None:
        infos = [record.agent_info for record in file.records]
        count = len(infos)
        self.spec = spec
        self.frames = [np.empty((count, *sensor.shape), np.float32) for sensor in spec.observation_specs]
        self.reward, self.group_reward = np.empty(count, np.float32), np.empty(count, np.float32)
        self.done = np.array([info.done for info in infos], bool)
        self.interrupted = np.array([info.done and info.max_step_reached for info in infos], bool)
        self.agent = np.array([info.id for info in infos], np.int64)

        total = sum(spec.action_spec.discrete_branches)
        masked = total and any(info.action_mask for info in infos)
        self.mask = np.ones((count, total), bool) if masked else None

        # an image may be sent as PNG in one record and as numbers in another
        ways: dict[tuple[int, ...], list[int]] = {}
        for row, info in enumerate(infos):
            ways.setdefault(tuple(o.compression_type for o in info.observations), []).append(row)
        decoder = BehaviorDecoder(file.behavior.brain_name, spec)
        for rows in ways.values():
            self._fill(decoder, infos, np.array(rows))

        self.actions = _Actions(spec, [record.action_info for record in file.records])

    def _fill(self, decoder: BehaviorDecoder, infos: list[Any], rows: np.ndarray) -> None:
        decisions, terminals = decoder.decode([infos[row] for row in rows])
        for steps, where in ((decisions, rows[~self.done[rows]]), (terminals, rows[self.done[rows]])):
            if not len(where):
                continue
            for frame, obs in zip(self.frames, steps.obs):
                frame[where] = obs
            self.reward[where], self.group_reward[where] = steps.reward, steps.group_reward

        asked = rows[~self.done[rows]]
        if self.mask is not None and len(asked):
            self.mask[asked] = ~np.concatenate(decisions.action_mask, axis=1)


class _Actions:
    """The actions that records hold: float32 ``[R, C]`` and int32 ``[R, K]``, zeros where there is none.

    Raises:
        ValueError: they are not of the behavior's kind.
    """

    def __init__(self, spec: BehaviorSpec, values: list[Any]) -> None:
        size, branches = spec.action_spec.continuous_size, spec.action_spec.discrete_branches
        self.continuous = np.zeros((len(values), size), np.float32)
        self.discrete = np.zeros((len(values), len(branches)), np.int32)
        # the field of recorders before ML-Agents 1.5, for both kinds
        self.are_old = any(v.vector_actions_deprecated for v in values)
        self.filled = np.array(
            [bool(v.continuous_actions or v.discrete_actions or v.vector_actions_deprecated) for v in values]
        )

        if self.filled.any():
            action = decode_actions(spec, [value for value, has in zip(values, self.filled) if has])
            if size:
                self.continuous[self.filled] = action.continuous
            if branches:
                self.discrete[self.filled] = action.discrete

        if not np.isfinite(self.continuous).all():
            raise ValueError("an action is not a finite number")
        if (self.discrete < 0).any() or (self.discrete >= np.array(branches, np.int32)).any():
            raise ValueError(f"a discrete action is not within its branch, of sizes {tuple(branches)}")

    def repeat(self, rows: np.ndarray) -> bool:
        """Tell whether in each of these records the action is that of the record before."""
        return all(np.array_equal(kind[rows], kind[rows - 1]) for kind in (self.continuous, self.discrete))


def _paired(path: Path, file: DemoFile, table: _Table) -> Demonstration:
    """Return the decisions of the records, each with its action and what the next record says of it."""
    # A new agent without an end of the one before: nothing says what followed that one's last record.
    goes_on = ~table.done[:-1] & (table.agent[1:] == table.agent[:-1])
    rows = np.flatnonzero(goes_on)
    if not len(rows):
        raise ConfigError(f"demonstration {path} has no decision that anything followed")

    following = rows + 1
    taken = following if file.has_tail else rows
    has_action = table.actions.filled[taken]
    ends = following[table.done[following]]
    # Recorders since ML-Agents 1.5 copy an action when the *next* decision is requested: at an end they write
    # the copy before once more, and the last action is nowhere (Agent.cs, NotifyAgentDone).
    if file.has_tail and not table.actions.are_old and table.actions.repeat(ends):
        has_action = has_action & ~table.done[following]

    return Demonstration(
        source=str(path),
        behavior=file.behavior.brain_name,
        spec=table.spec,
        frames=table.frames,
        rows=rows,
        continuous=table.actions.continuous[taken],
        discrete=table.actions.discrete[taken],
        has_action=has_action,
        mask=None if table.mask is None else table.mask[rows],
        reward=table.reward[following],
        group_reward=table.group_reward[following],
        done=table.done[following],
        interrupted=table.interrupted[following],
        first=np.concatenate([[True], ~goes_on])[rows],
    )
