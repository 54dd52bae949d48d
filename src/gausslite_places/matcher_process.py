"""Match surfaces by `kiss-matcher` in a process of their own: it keeps memory of each call, up to 20 MB.

The process gets and returns arrays, and unpickles nothing. It ends when it has grown, and with its connection, so also
when the process that started it is killed.
"""

from __future__ import annotations

import atexit
import os
import resource
import signal
import subprocess
import sys
from contextlib import suppress
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from threading import Lock

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.domain.errors import UnavailableError
from gausslite.process import import_extra

_COMMAND = (sys.executable, "-m", "gausslite_places.matcher_process")
_MAX_GROWTH_KIB = 100 << 10
_ATTEMPTS = 3
"""The first process may have ended by its growth, the second one by a crash."""


class MatcherProcess:
    """Starts the process with the first call."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._connection: Connection | None = None

    def __call__(
        self, source_m: Float64[ndarray, "n 3"], target_m: Float64[ndarray, "m 3"], spacing_m: float, min_inliers: int
    ) -> Float64[ndarray, "4 4"] | None:
        """Return T_target_source; None with too few matches. Raises UnavailableError if the process ends each time."""
        with self._lock:
            for _ in range(_ATTEMPTS):
                try:
                    connection = self._running()
                    connection.send_bytes(np.array([spacing_m, min_inliers]).tobytes())
                    for points_m in (source_m, target_m):
                        connection.send_bytes(points_m.astype(np.float64).tobytes())
                    T = np.frombuffer(connection.recv_bytes(), np.float64)
                    return T.reshape(4, 4).copy() if len(T) else None
                except (OSError, EOFError):
                    self.close()
        raise UnavailableError(f"registration without a guess: its process ended {_ATTEMPTS} times")

    def close(self) -> None:
        """End the process."""
        if self._process is not None and self._connection is not None:
            self._connection.close()
            self._process.kill()
            self._process.wait()
        self._process = self._connection = None

    def _running(self) -> Connection:
        if self._connection is None:
            self._connection, theirs = Pipe()
            with theirs:
                # a session of its own: Ctrl-C reaches only the process that ends this one
                self._process = subprocess.Popen(  # noqa: S603 - this interpreter
                    _COMMAND, stdin=theirs.fileno(), stdout=subprocess.DEVNULL, start_new_session=True
                )
        return self._connection


MATCHER = MatcherProcess()
atexit.register(MATCHER.close)


def _serve(connection: Connection) -> None:
    """Answer until the process has grown, or the other end of the connection is closed."""
    kiss_matcher = import_extra("kiss_matcher", "slam", "registration without a guess")

    first_kib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with suppress(OSError, EOFError):
        while resource.getrusage(resource.RUSAGE_SELF).ru_maxrss < first_kib + _MAX_GROWTH_KIB:
            spacing_m, min_inliers = np.frombuffer(connection.recv_bytes(), np.float64).tolist()
            clouds = [np.frombuffer(connection.recv_bytes(), np.float64).reshape(-1, 3) for _ in range(2)]
            config = kiss_matcher.KISSMatcherConfig(voxel_size=spacing_m, use_voxel_sampling=False)
            matcher = kiss_matcher.KISSMatcher(config)
            found = matcher.estimate(*(list(points_m.astype(np.float32)) for points_m in clouds))
            is_found = found.valid and matcher.get_num_final_inliers() >= min_inliers
            T = np.eye(4)
            T[:3, :3], T[:3, 3] = found.rotation, np.asarray(found.translation).ravel()
            connection.send_bytes(T.tobytes() if is_found else b"")


if __name__ == "__main__":
    # whoever started this process ends it
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    _serve(Connection(os.dup(sys.stdin.fileno())))
