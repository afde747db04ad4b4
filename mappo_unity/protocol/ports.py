"""Ports of the loopback address: whether one can be listened on.

This is found out before gRPC tries, which prints a line of its own where a port is taken.
"""

from __future__ import annotations

import errno
import os
import socket

from mappo_unity.errors import ConfigError

ADDRESS = "127.0.0.1"
EDITOR_PORT = 5004
"""Port on which Unity's Editor looks for a trainer, and a trainer waits for it."""
FREE, LINGERS, TAKEN, FORBIDDEN = "free", "TIME_WAIT", "in use", "forbidden"


def port_state(port: int) -> str:
    """Return "free", "TIME_WAIT", "in use" or "forbidden" for a port of the loopback address."""
    # A port in TIME_WAIT can be had with SO_REUSEADDR only, one that is held not even so.
    for reuse, verdict in ((0, FREE), (1, LINGERS)):
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, reuse)
            try:
                probe.bind((ADDRESS, port))
                return verdict
            except OSError as error:
                if error.errno in (errno.EACCES, errno.EPERM):
                    return FORBIDDEN
            if os.name == "nt":  # there SO_REUSEADDR takes a port from who holds it
                break

    return TAKEN


def check_port(port: int, option: str) -> None:
    """Raise ConfigError if a port that an option names cannot be listened on (port 0: any will do)."""
    state = port_state(port) if port else FREE
    if state == TAKEN:
        raise ConfigError(
            f"port {port} of {ADDRESS} is in use: another training run, or a game started by hand, holds it; "
            f"end that one, or choose another port ({option}) on both sides"
        )

    if state == FORBIDDEN:
        raise ConfigError(
            f"port {port} of {ADDRESS} may not be listened on by this user: choose one from 1024 up "
            f"({option})"
        )
