"""The matches of a league: every pair on both sides, several pairs at a time in processes of their own.

What a pair plays depends on the league's seed and on the pair's place in it, and on nothing that happened
before: an interrupted league goes on to the same results, however many processes there are.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any

import numpy as np

from mappo_unity.config.schema import EnvConfig
from mappo_unity.errors import EnvironmentFailure
from mappo_unity.policies.league.checks import League, Player, begun, check_unchanged
from mappo_unity.policies.league.table import Pair, Result, pairs_of, read_results, write_results
from mappo_unity.runs.folder import PLAYERS
from mappo_unity.signals import Interrupted

Told = Callable[[Pair, list[Result], int, int], None]
"""Takes a pair, its results, and how many pairs of how many are done."""


@dataclass(frozen=True)
class Task:
    """A pair's matches, with all that its process needs."""

    first: Player
    second: Player
    env: EnvConfig
    matches: int
    deterministic: bool
    seeds: tuple[int, int, int]  # of the environment, and of the two players
    logs: Path

    @property
    def pair(self) -> Pair:
        """The two players' names."""
        return self.first.name, self.second.name


def play_league(league: League, workers: int | None, told: Told) -> dict[Pair, list[Result]]:
    """Play the pairs that the league's folder lacks; after each, write the results there.

    Args:
        league: who plays whom.
        workers: processes; None: as many as the machine has cores.
        told: called after each pair.

    Returns:
        The results of all pairs.

    Raises:
        ConfigError: the folder cannot be written or is in use, or a policy does not fit the environment.
        EnvironmentFailure: an environment, or a process, has failed for good.
    """
    with begun(league):
        results = read_results(league.folder)
        tasks = [task for task in tasks_of(league) if task.pair not in results]
        total = len(results) + len(tasks)

        for task, rows in _played(tasks, min(workers or os.cpu_count() or 1, len(tasks))):
            results[task.pair] = rows
            write_results(league.folder, results, league.names)
            told(task.pair, rows, len(results), total)
    return results


def tasks_of(league: League) -> list[Task]:
    """Return the matches of all pairs."""
    players = {player.name: player for player in league.players}
    tasks = []
    for number, (first, second) in enumerate(pairs_of(league.names)):
        drawn = np.random.SeedSequence([league.seed, number]).generate_state(3) % 2**31
        env, one, other = (int(seed) for seed in drawn)
        logs = league.folder / PLAYERS / f"pair-{number:03}"
        pair = players[first], players[second]
        tasks.append(Task(*pair, league.env, league.matches, league.deterministic, (env, one, other), logs))
    return tasks


def play_pair(task: Task) -> list[Result]:
    """Play a pair's matches; return the first one's results as each side.

    Raises:
        ConfigError: a player's file is another one than at the league's beginning, or does not fit.
        Interrupted: the process was told to end.
    """
    global _is_playing
    _is_playing = True
    try:
        return _play(task)
    finally:
        _is_playing = False


def _play(task: Task) -> list[Result]:
    import torch

    from mappo_unity.envs.backends import make_env_function
    from mappo_unity.policies.evaluate import open_policy
    from mappo_unity.policies.matches import play_matches

    if _stopped:  # a task that was already on its way when the league ended
        raise Interrupted(signal.SIGTERM)
    torch.set_num_threads(1)
    env_seed, *seeds = task.seeds
    torch.manual_seed(env_seed)

    pair = zip((task.first, task.second), seeds)
    policy, opponent = (open_policy(player.where, task.deterministic, seed) for player, seed in pair)
    # only now: a file that is replaced while it is opened is found, too
    for player in (task.first, task.second):
        check_unchanged(player)
    make_env = make_env_function(task.env, task.logs)
    scores = play_matches(make_env, policy, opponent, task.matches, env_seed)
    return [
        Result(*task.pair, side, score.wins, score.draws, score.losses, score.decisions)
        for side, score in scores.items()
    ]


def _played(tasks: list[Task], workers: int) -> Iterator[tuple[Task, list[Result]]]:
    """Yield the tasks with their results as they come."""
    if workers <= 1:
        for task in tasks:
            yield task, play_pair(task)
        return

    with _processes(workers) as pool:
        futures = {pool.submit(play_pair, task): task for task in tasks}
        try:
            for future in as_completed(futures):
                yield futures[future], future.result()
        except BrokenProcessPool as error:
            raise EnvironmentFailure(
                "a process of the league was ended from outside, perhaps for want of memory: workers=N sets "
                "their number; the same command goes on where this one ended"
            ) from error


@contextmanager
def _processes(count: int) -> Iterator[ProcessPoolExecutor]:
    """Give processes to play in; an exception ends them without waiting for their matches."""
    before = set(multiprocessing.active_children())
    # "spawn": a copy of a process in which torch has run may hang
    pool = ProcessPoolExecutor(count, multiprocessing.get_context("spawn"), initializer=_begin_process)
    try:
        yield pool
    except BaseException:
        pool.shutdown(wait=False, cancel_futures=True)
        for child in set(multiprocessing.active_children()) - before:
            child.terminate()
        raise
    finally:
        pool.shutdown()


_is_playing = False  # whether this process plays a pair: there is something to close
_stopped = False  # whether it has been told to end meanwhile


def _begin_process() -> None:
    """Leave Ctrl-C to the league's process, end the matches at SIGTERM, and do not outlive the league."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, _stop)
    parent: Any = multiprocessing.parent_process()

    def follow() -> None:
        wait([parent.sentinel])
        os._exit(1)

    threading.Thread(target=follow, daemon=True).start()


def _stop(number: int, frame: Any) -> None:
    # between pairs nobody would catch an exception: its traceback would be printed
    if not _is_playing:
        os._exit(128 + number)

    # raised once, so that players are closed; a second one must not break that off
    global _stopped
    if not _stopped:
        _stopped = True
        raise Interrupted(number)
