"""A Unity player that misbehaves, for the tests of the trainer's side.

Usage: bad_player.py MODE AFTER <arguments of a player>. Plays 3DBall with two areas; from its message number
AFTER on it does what MODE says.
"""

from __future__ import annotations

import os
import signal
import struct
import sys
import time
from collections.abc import Callable

import grpc
import numpy as np

from mappo_unity.protocol import encode, messages
from mappo_unity.protocol.serve import Player, env_function
from mappo_unity.protocol.side_channels import ENGINE, STATISTICS
from mappo_unity.scenes.ball3d.scene import Ball3D


class NaNBall(Ball3D):
    """3DBall whose second agent reports NaN after some ticks."""

    after = 0

    def observe(self, behavior: int, slots: np.ndarray) -> list[np.ndarray]:
        frames = super().observe(behavior, slots)
        if self.counter > 5 * NaNBall.after:
            frames[0][slots == 1, 3] = np.nan
        return frames


def misbehave(mode: str, after: int, exchange: Callable[[bytes], bytes]) -> Callable[[bytes], bytes]:
    """Return an exchange that goes wrong from message `after` on."""
    count = 0

    def bad(data: bytes) -> bytes:
        nonlocal count
        count += 1
        if count <= after:
            return exchange(data)
        if mode == "malformed":
            return exchange(b"\x12\xff\xff\xff")  # a field that claims more bytes than there are
        if mode == "crash":
            os.kill(os.getpid(), signal.SIGKILL)
        if mode == "exit":
            sys.exit(7)
        if mode == "hang":
            time.sleep(3600)
        if mode == "close":
            exchange(messages.message(messages.STATUS_QUIT, text="Academy was destroyed"))
            sys.exit(0)
        if mode == "silent":  # answers, but no agent ever asks
            return exchange(messages.message(messages.STATUS_OK, unity_output=encode.output({})))
        if mode in ("statistics", "engine"):  # cut short; on a channel that only the trainer writes to
            channel, content = (STATISTICS, b"\1\0\0\0a\0\0") if mode == "statistics" else (ENGINE, b"")
            side = channel.bytes_le + struct.pack("<i", len(content)) + content
            return exchange(messages.message(messages.STATUS_OK, unity_output=encode.output({}, None, side)))
        if mode == "version":
            hello = b"".join(
                messages.delimited(field, text) for field, text in ((1, b"Old"), (2, b"2.0.0"), (7, b"9.9.9"))
            )
            return exchange(messages.message(messages.STATUS_OK, unity_output=messages.delimited(2, hello)))
        raise ValueError(mode)

    return bad


def main() -> None:
    """Play, then misbehave."""
    mode, after = sys.argv[1], int(sys.argv[2])
    arguments = sys.argv[3:]
    port = int(arguments[arguments.index("--mlagents-port") + 1])
    log = arguments[arguments.index("-logFile") + 1]
    with open(log, "w", encoding="utf-8") as file:
        print("bad player", file=file)
    channel = grpc.insecure_channel(f"localhost:{port}")
    exchange = channel.unary_unary(messages.METHOD)
    if mode == "nan":
        NaNBall.after = after
        Player(lambda seed, areas: NaNBall(seed=seed, num_areas=2), "3DBall").play(exchange)
    else:
        Player(env_function("3DBall", 2), "3DBall").play(misbehave(mode, after, exchange))


if __name__ == "__main__":
    main()
