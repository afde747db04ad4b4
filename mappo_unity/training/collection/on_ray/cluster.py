"""The Ray cluster that a run's workers live in: one that is there already, or one of the run's own."""

from __future__ import annotations

import logging
import os
import signal
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import ray

from mappo_unity.errors import ConfigError

ADDRESS = "RAY_ADDRESS"
CONNECT_S = 10.0
NICENESS = "RAY_worker_niceness"  # Ray's own variable
WORKER_CPUS = 1
"""CPUs that a worker asks for."""


class Cluster:
    """A connection to a cluster; `leave` ends what was begun here, and nothing else.

    A process that is connected already stays so. Else `RAY_ADDRESS` names a cluster; without it one is
    started, on this machine.

    Args:
        workers: how many there must be room for in a cluster that is started.

    Raises:
        ConfigError: no cluster answers at that address.
    """

    def __init__(self, workers: int) -> None:
        self._is_ours = not ray.is_initialized()
        if not self._is_ours:
            return

        address = os.environ.get(ADDRESS) or "local"
        if address.startswith("ray://"):
            raise ConfigError(
                f"{ADDRESS}={address} is a Ray client's address; run on a machine of the cluster, with "
                f"{ADDRESS}=auto, or give the address of its head node: {ADDRESS}=HOST:6379"
            )
        _check_answers(address)

        own: dict[str, Any] = {"num_cpus": workers * WORKER_CPUS, "include_dashboard": False}
        if NICENESS not in os.environ:
            # Ray's own value of 15 starves workers beside any other work, while the learner waits for them
            own["_system_config"] = {"worker_niceness": 0}
        if address == "local":
            os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # no reports from a run to Ray's makers
        with _handlers_kept():
            try:
                ray.init(
                    address,
                    log_to_driver=False,
                    logging_level=logging.ERROR,
                    **(own if address == "local" else {}),
                )
            except (ConnectionError, OSError, RuntimeError, ValueError) as error:
                if address == "local":
                    raise
                raise _no_cluster(address, error) from error

    def leave(self) -> None:
        """End the connection, and a cluster that was started for it."""
        if self._is_ours and ray.is_initialized():
            with _handlers_kept():
                ray.shutdown()
        self._is_ours = False


def describe_room() -> str:
    """Return how many CPUs the cluster has."""
    total, free = (figures.get("CPU", 0) for figures in (ray.cluster_resources(), ray.available_resources()))
    machines = sum(node["Alive"] for node in ray.nodes())
    return f"the Ray cluster has {total:g} on {machines} machine(s), {free:g} of them free"


def _check_answers(address: str) -> None:
    """Raise ConfigError where nobody listens at ``host:port``: Ray would try for minutes."""
    host, _, port = address.rpartition(":")
    if not host or not port.isdecimal():
        return
    try:
        socket.create_connection((host.strip("[]"), int(port)), CONNECT_S).close()
    except (OSError, OverflowError) as error:
        raise _no_cluster(address, error) from error


def _no_cluster(address: str, error: Exception) -> ConfigError:
    reason = " ".join(str(error).split()) or type(error).__name__
    return ConfigError(
        f"{ADDRESS}={address}: no Ray cluster answers there ({reason}); start one with `ray start --head`, "
        f"or unset {ADDRESS} for one of this run's own"
    )


@contextmanager
def _handlers_kept() -> Iterator[None]:
    """Keep the handlers of signals; Ray puts one of its own in the place of that of SIGTERM."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
