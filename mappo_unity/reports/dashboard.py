"""A page that follows a run while it trains, for browsers on this machine.

A thread of the training process serves it, on the loopback address alone. It only reads the run's folder, and
only when a browser asks; what it builds is kept until metrics.csv changes, and the page is told to ask so
rarely that building costs a fiftieth of one core at most. Nothing that fails here reaches the run.
"""

from __future__ import annotations

import json
import os
import socketserver
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from mappo_unity.config.schema import LogConfig
from mappo_unity.errors import ConfigError

HOST = "127.0.0.1"
REFRESH_S = 3.0
"""Seconds between two questions of a page, at least."""
_SHARE = 50  # of the time that building takes: how long the page waits before it asks again
_TIMEOUT_S = 10.0  # for a browser that says nothing


@contextmanager
def dashboard(cfg: LogConfig, folder: Path) -> Iterator[str | None]:
    """Serve the page of a run's folder while the context lasts; yield its address, None where none is wanted.

    Raises:
        ConfigError: the port cannot be had.
    """
    if not cfg.dashboard:
        yield None
        return

    server = _Server((HOST, cfg.dashboard_port or 0), folder)
    # a daemon: an exception that ends the process must not wait for a browser
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.2}, daemon=True)
    thread.start()
    try:
        yield f"http://{HOST}:{server.server_port}/"
    finally:
        server.shutdown()
        server.server_close()


class Answers:
    """What the page asks for: the tables and curves of a run, as JSON, as of its newest row."""

    def __init__(self, folder: Path, clock: Callable[[], float] = time.thread_time) -> None:
        self._folder = folder
        self._clock = clock
        self._lock = threading.Lock()
        self._version: tuple[int, int] | None = None
        self._answer = b""

    def newest(self) -> bytes:
        """Return the newest answer; several pages that ask at once make it once."""
        with self._lock:
            version = self._file_version()
            if version != self._version or not self._answer:
                self._answer, self._version = self._build(), version
            return self._answer

    def _file_version(self) -> tuple[int, int] | None:
        from mappo_unity.reports.reading import METRICS

        try:
            state = (self._folder / METRICS).stat()
        except OSError:
            return None
        return state.st_size, state.st_mtime_ns

    def _build(self) -> bytes:
        # only now: a run that nobody watches loads nothing of this
        from mappo_unity.reports.page import page_content
        from mappo_unity.reports.reading import read_run

        started_s = self._clock()
        answer: dict[str, Any] = {"sections": {}, "data": None, "message": "no metrics yet"}
        try:
            run = read_run(self._folder)
            if run.columns:
                answer |= page_content([run])
        except Exception as error:  # whatever it is, the page says it, and asks again
            answer["message"] = f"the run cannot be read now ({error})"

        refresh_s = max(REFRESH_S, _SHARE * (self._clock() - started_s))
        return json.dumps({**answer, "refresh_s": refresh_s}, allow_nan=False).encode()


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    allow_reuse_address = os.name == "posix"  # elsewhere it lets two servers have one port

    def __init__(self, address: tuple[str, int], folder: Path) -> None:
        self.answers = Answers(folder)
        self.title = f"{folder.resolve().parent.name}/{folder.resolve().name}"
        try:
            super().__init__(address, _Handler)
        except OSError as error:
            raise ConfigError(
                f"log.dashboard_port={address[1]} cannot be had ({error.strerror or error}): another run, or "
                "another program, serves there; take another port, or null for one that is free"
            ) from error

    def server_bind(self) -> None:
        """Bind without looking up this machine's name, which may ask a name server."""
        socketserver.TCPServer.server_bind(self)
        self.server_name, self.server_port = HOST, self.server_address[1]

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Say nothing: a browser that went away is no news for whoever watches the run."""


class _Handler(BaseHTTPRequestHandler):
    server: _Server
    timeout = _TIMEOUT_S
    protocol_version = "HTTP/1.1"

    def do_GET(self) -> None:
        """Answer with the page, its data, or nothing."""
        # A page elsewhere whose name was pointed at this address must not read a run. The port may be another
        # one, that of a tunnel.
        host = (self.headers.get("Host") or "").partition(":")[0]
        if host not in (HOST, "localhost"):
            self._answer(403, "text/plain", b"")
        elif self.path == "/":
            from mappo_unity.reports.page import live_page

            # a folder's name need not be UTF-8
            page = live_page(self.server.title).encode(errors="backslashreplace")
            self._answer(200, "text/html; charset=utf-8", page)
        elif self.path == "/data.json":
            self._answer(200, "application/json", self.server.answers.newest())
        else:
            self._answer(404, "text/plain", b"")

    def log_message(self, format: str, *args: Any) -> None:
        """Log nothing: the terminal is the run's."""

    def _answer(self, status: int, kind: str, body: bytes) -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body)))
        self.send_header("Cache-Control", "no-store")
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header("Cross-Origin-Resource-Policy", "same-origin")
        self.end_headers()
        self.wfile.write(body)
