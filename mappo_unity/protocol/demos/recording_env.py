"""Record whatever a BaseEnv plays, whoever gives the actions."""

from __future__ import annotations

import os
from collections.abc import Iterable
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from mlagents_envs.base_env import ActionTuple, BaseEnv, BehaviorMapping, DecisionSteps, TerminalSteps

from mappo_unity import keys
from mappo_unity.errors import ConfigError
from mappo_unity.protocol.demos.demo_file import SUFFIX
from mappo_unity.protocol.demos.writer import DemoWriter


class Recorded(NamedTuple):
    """What a file holds so far."""

    path: Path
    episodes: int
    decisions: int


class RecordingEnv(BaseEnv):
    """Hand every call on, and write what is played to demonstrations; `close` completes them.

    Both sides of a policy go into one file. What BaseEnv does not have is the wrapped environment's own.

    Args:
        env: the environment; it is closed with this one.
        path: a new file NAME.demo, where there is one policy name, or a folder for NAME.demo of each.

    Raises:
        ConfigError: see `recording_files`; of behaviors that appear later, too.
    """

    def __init__(self, env: BaseEnv, path: str | Path) -> None:
        self._env, self._path = env, Path(path)
        self._writers: dict[str, DemoWriter] = {}
        self._actions: dict[str, ActionTuple] = {}
        self._is_new = False  # the newest results are not recorded yet
        recording_files(self._path, env.behavior_specs)

    def __getattr__(self, attribute: str) -> Any:
        if attribute == "_env":  # not there yet, in a copy that is being made
            raise AttributeError(attribute)
        return getattr(self._env, attribute)

    @property
    def recorded(self) -> list[Recorded]:
        """The files, and how much was written to each; complete after `close`."""
        return [Recorded(w.path, w.episodes, w.decisions) for w in self._writers.values()]

    @property
    def behavior_specs(self) -> BehaviorMapping:
        """The environment's behaviors."""
        return self._env.behavior_specs

    def step(self) -> None:
        """Record what was decided, then step the environment."""
        self._record()
        self._env.step()
        self._is_new = True

    def reset(self) -> None:
        """End the recorded episodes as interrupted, then reset the environment."""
        self._record()
        for writer in self._writers.values():
            writer.cut()
        self._env.reset()
        self._is_new = True

    def close(self) -> None:
        """Complete the files, then close the environment."""
        try:
            self._record()
        finally:
            # whatever fails, the rest is still done
            with ExitStack() as stack:
                stack.callback(self._env.close)
                for writer in self._writers.values():
                    stack.callback(writer.close)

    def set_actions(self, behavior_name: str, action: ActionTuple) -> None:
        """Hand the actions of a behavior's agents on."""
        self._env.set_actions(behavior_name, action)
        self._actions[behavior_name] = action

    def set_action_for_agent(self, behavior_name: str, agent_id: int, action: ActionTuple) -> None:
        """Hand one agent's action on."""
        self._env.set_action_for_agent(behavior_name, agent_id, action)

        decision, _ = self._env.get_steps(behavior_name)
        known = self._actions.get(behavior_name) or self._no_action(behavior_name, len(decision))
        row, whole = decision.agent_id_to_index[agent_id], ActionTuple()
        for add, rows, given in (
            (whole.add_continuous, known.continuous, action.continuous),
            (whole.add_discrete, known.discrete, action.discrete),
        ):
            if rows is not None and given is not None:
                add(np.concatenate([rows[:row], given, rows[row + 1 :]]))
        self._actions[behavior_name] = whole

    def get_steps(self, behavior_name: str) -> tuple[DecisionSteps, TerminalSteps]:
        """Return a behavior's records."""
        return self._env.get_steps(behavior_name)

    def _record(self) -> None:
        """Record the newest results, once; who got no action got ML-Agents' empty one."""
        if not self._is_new:
            return
        self._is_new = False

        for name in self._env.behavior_specs:
            decision, terminal = self._env.get_steps(name)
            action = self._actions.get(name) or self._no_action(name, len(decision))
            if len(decision) or len(terminal):
                self._writer(name).record(decision, terminal, action)
        self._actions.clear()

    def _no_action(self, behavior_name: str, agents: int) -> ActionTuple:
        return self._env.behavior_specs[behavior_name].action_spec.empty_action(agents)

    def _writer(self, behavior_name: str) -> DemoWriter:
        name = keys.policy_name(behavior_name)
        if name not in self._writers:
            specs = self._env.behavior_specs
            file = recording_files(self._path, specs)[name]
            self._writers[name] = DemoWriter(file, name, specs[behavior_name])
        return self._writers[name]


def recording_files(path: Path, behaviors: Iterable[str]) -> dict[str, Path]:
    """Return the file of each policy name that a recording writes.

    Args:
        path: NAME.demo, or a folder.
        behaviors: names of the environment's behaviors; there may be none yet.

    Raises:
        ConfigError: one file for several policy names, another ending, a file that is there already, a folder
            that cannot be written.
    """
    names = list(dict.fromkeys(keys.policy_name(name) for name in behaviors))
    is_file = path.suffix == SUFFIX
    if not is_file and path.suffix and not path.is_dir():
        raise ConfigError(f"recording {path} must end in {SUFFIX}, or be a folder for NAME{SUFFIX}")
    if is_file and len(names) > 1:
        files = " and ".join(f"{keys.file_stem(name)}{SUFFIX}" for name in names)
        raise ConfigError(
            f"recording {path} would be of several behaviors, but a file is of one: name a folder, such as "
            f"{path.with_suffix('')}{os.sep}, for {files}"
        )

    files_of = {name: path if is_file else path / f"{keys.file_stem(name)}{SUFFIX}" for name in names}
    for file in files_of.values():
        if file.exists():
            raise ConfigError(f"recording {file} exists already: give another name, or delete it")

    wanted = path.absolute().parent if is_file else path.absolute()
    folder = wanted if is_file else next(place for place in (wanted, *wanted.parents) if place.exists())
    if not folder.is_dir() or not os.access(folder, os.W_OK | os.X_OK):
        raise ConfigError(f"recording {path} cannot be written: {folder} is no folder that can be written")
    return files_of
