"""Compare maps in a process of their own: registrations hold the interpreter's lock for a tenth of a second at a time.

The process gets arrays and answers with JSON; it unpickles nothing. It ends with its connection, so also when the
process that started it is killed.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from threading import Lock, Timer
from typing import Any

import numpy as np

from gausslite.domain.errors import UnavailableError
from gausslite.fusion.frames import FrameFit
from gausslite_places.frame_fit import SurfaceSamples, fit_frame
from gausslite_places.unknown_frames import FrameSearch, find_frame

_COMMAND = (sys.executable, "-m", "gausslite_places.fit_process")
_NICENESS = 10
_LONGEST_S = 120.0
"""A comparison takes a second, and some more on a busy machine, whose other processes come first."""
_ATTEMPTS = 2
_ROW_VALUES = 4
_FIT, _FIND = b"fit", b"find"


class FitProcess:
    """Calls `fit_frame` and `find_frame` in a process, from one thread; the first call starts it."""

    def __init__(self, command: Sequence[str] = _COMMAND, longest_s: float = _LONGEST_S) -> None:
        """longest_s: a process that has not answered by then is killed."""
        self._command, self._longest_s = command, longest_s
        self._lock = Lock()
        self._is_closed = False
        self._process: subprocess.Popen[bytes] | None = None
        self._connection: Connection | None = None

    @property
    def pid(self) -> int | None:
        """The id of the process; None before the first call and after `close`."""
        return None if self._process is None else self._process.pid

    def __call__(self, source: SurfaceSamples, target: SurfaceSamples) -> FrameFit | None:
        """Return `fit_frame` of the samples. Raises UnavailableError if it fails, or the process ends in two attempts.

        A process that is killed, for example because memory ran out, is started again for the second attempt.
        """
        return self._ask(_FIT, source, target).fit

    def find(self, source: SurfaceSamples, target: SurfaceSamples) -> FrameSearch:
        """Return `find_frame` of the samples. Raises UnavailableError as a call does."""
        return self._ask(_FIND, source, target)

    def _ask(self, question: bytes, source: SurfaceSamples, target: SurfaceSamples) -> FrameSearch:
        for _ in range(_ATTEMPTS):
            process, connection = self._running()
            timer = Timer(self._longest_s, process.kill)
            timer.daemon = True
            timer.start()
            try:
                connection.send_bytes(question)
                for samples in (source, target):
                    connection.send_bytes(np.column_stack([samples.points_m, samples.luminance]).tobytes())
                answer: dict[str, Any] = json.loads(connection.recv_bytes())
                break
            except (OSError, EOFError):
                code = self._end()
            finally:
                timer.cancel()
        else:
            raise UnavailableError(f"the process of the comparisons ended {_ATTEMPTS} times, with code {code}")
        if "error" in answer:
            raise UnavailableError(answer["error"])
        return FrameSearch(answer["fit"] and FrameFit.from_json(answer["fit"]), answer["reason"])

    def close(self) -> None:
        """End the process; a call that runs raises UnavailableError, and so do later ones."""
        with self._lock:
            self._is_closed = True
        self._end()

    def _running(self) -> tuple[subprocess.Popen[bytes], Connection]:
        """Return the process and the connection to it; a process is started if none runs."""
        with self._lock:
            if self._is_closed:
                raise UnavailableError("the process of the comparisons was closed")
            if self._process is None or self._connection is None:
                self._process, self._connection = self._start()
            return self._process, self._connection

    def _start(self) -> tuple[subprocess.Popen[bytes], Connection]:
        connection, theirs = Pipe()
        with theirs:
            try:
                # a session of its own: Ctrl-C reaches only the server, which ends this process
                process = subprocess.Popen(  # noqa: S603 - this interpreter
                    self._command, stdin=theirs.fileno(), stdout=subprocess.DEVNULL, start_new_session=True
                )
            except OSError as error:
                raise UnavailableError(f"the process of the comparisons does not start: {error}") from error
        return process, connection

    def _end(self) -> int | None:
        """Kill the process if it runs; returns its exit code."""
        with self._lock:
            process, self._process, self._connection = self._process, None, None
        if process is None:
            return None
        process.kill()
        return process.wait()


def _serve(connection: Connection) -> None:
    """Answer comparisons until the other end of the connection is closed."""
    with suppress(OSError, EOFError):
        while True:
            question = connection.recv_bytes()
            source, target = (_samples(connection.recv_bytes()) for _ in range(2))
            connection.send_bytes(json.dumps(_answer(question, source, target), default=np.ndarray.tolist).encode())


def _answer(question: bytes, source: SurfaceSamples, target: SurfaceSamples) -> dict[str, object]:
    try:
        found = FrameSearch(fit_frame(source, target)) if question == _FIT else find_frame(source, target)
    except Exception as error:
        # the next comparison may succeed
        return {"error": f"{type(error).__name__}: {error}"}
    return {"fit": found.fit and asdict(found.fit), "reason": found.reason}


def _samples(data: bytes) -> SurfaceSamples:
    rows = np.frombuffer(data, np.float64).reshape(-1, _ROW_VALUES)
    return SurfaceSamples(rows[:, :3].copy(), rows[:, 3].copy())


if __name__ == "__main__":
    # whoever started this process ends it
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    os.nice(_NICENESS)
    _serve(Connection(sys.stdin.fileno()))
