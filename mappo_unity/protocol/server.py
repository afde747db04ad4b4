"""The trainer's end of the connection: a gRPC server on the loopback address that one player calls.

Other addresses of the machine are not listened on.
"""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable
from concurrent.futures import Executor, Future
from typing import Any

import grpc

from mappo_unity.errors import ConfigError
from mappo_unity.protocol.messages import METHOD, OPTIONS, STATUS_QUIT, message
from mappo_unity.protocol.ports import ADDRESS, check_port

POLL_S = 0.1  # how often the player's process is looked at while nothing comes
GRACE_S = 1.0  # for the goodbye to reach the player: without it gRPC may cut the call that carries it


class LinkTimeout(Exception):
    """The player sent nothing in time."""


class Link:
    """Listen for one player.

    A player's request is answered by `reply`; then `receive` waits for its next one. The system picks a free
    port and keeps it (port 0), so no two links ever fight for one.

    Attributes: `port`, the port that is listened on.
    Raises ConfigError: the port given is in use.
    """

    def __init__(self, port: int = 0) -> None:
        check_port(port, "env.port")
        self._requests: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        self._answers: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        self._peer: str | None = None
        self._closing = False
        # One thread for the player's call, one to turn away whoever else calls.
        self._threads = _DaemonThreads(2)

        # gRPC shares a port with others if it may; then a port in use would go unnoticed.
        self._server = grpc.server(self._threads, options=(("grpc.so_reuseport", 0), *OPTIONS))
        self._server.add_generic_rpc_handlers((_Handler(self._exchange),))

        try:
            self.port = self._server.add_insecure_port(f"{ADDRESS}:{port}")
        except RuntimeError as error:
            raise ConfigError(f"port {port} of {ADDRESS} cannot be listened on: {error}") from error
        self._server.start()

    def receive(self, timeout_s: float, check: Callable[[], None] = lambda: None) -> bytes:
        """Return the player's next request.

        Args:
            timeout_s: seconds to wait.
            check: called now and then while waiting; may raise to end it.

        Raises:
            LinkTimeout: nothing came.
        """
        deadline = time.monotonic() + timeout_s

        while True:
            left = deadline - time.monotonic()
            try:
                return self._requests.get(timeout=max(0.0, min(POLL_S, left)))
            except queue.Empty:
                check()
                if left <= 0:
                    raise LinkTimeout(f"nothing came for {timeout_s:g} s") from None

    def reply(self, answer: bytes) -> None:
        """Answer the request received last."""
        self._answers.put(answer)

    def say_quit(self) -> None:
        """Tell the player to leave, now or when it calls next."""
        self._closing = True
        for _ in range(2):  # one for each thread that may wait
            self._answers.put(message(STATUS_QUIT))

    def close(self) -> None:
        """Stop listening; the port is free again."""
        self.say_quit()
        self._server.stop(GRACE_S).wait(5)
        self._threads.shutdown()

    def _exchange(self, request: bytes, context: Any) -> bytes:
        """Run in a thread of gRPC: hand a request over and wait for its answer."""
        # who calls first is the player
        peer = context.peer()
        if self._peer is None:
            self._peer = peer
        elif peer != self._peer:
            context.abort(grpc.StatusCode.FAILED_PRECONDITION, "this trainer has a player already")

        if self._closing:
            return message(STATUS_QUIT)

        self._requests.put(request)
        return self._answers.get()


class _Handler(grpc.GenericRpcHandler):
    """Route the one method, without (de)serializers: bytes in, bytes out."""

    def __init__(self, exchange: Callable[[bytes, Any], bytes]) -> None:
        self._method = grpc.unary_unary_rpc_method_handler(exchange)

    def service(self, handler_call_details: Any) -> Any:
        return self._method if handler_call_details.method == METHOD else None


class _DaemonThreads(Executor):
    """A pool of daemon threads: one that waits for an answer does not keep the trainer from ending."""

    def __init__(self, count: int) -> None:
        self._count = count
        self._work: queue.SimpleQueue[tuple[Future, Callable[[], Any]] | None] = queue.SimpleQueue()
        for number in range(count):
            threading.Thread(target=self._run, name=f"player-call-{number}", daemon=True).start()

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future:
        """Run a call in one of the threads."""
        future: Future = Future()
        self._work.put((future, lambda: fn(*args, **kwargs)))
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Let the threads end when they have no work left."""
        for _ in range(self._count):
            self._work.put(None)

    def _run(self) -> None:
        while (item := self._work.get()) is not None:
            future, call = item
            try:
                future.set_result(call())
            except BaseException as error:  # as concurrent.futures does: it belongs to the caller
                future.set_exception(error)
