"""Check the shapes in type annotations during every test, and locate optional data next to the project."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from pathlib import Path

import hypothesis
import pytest
from support import shape_checks
from support.postgres_running import PostgresServer, postgres_server

WITH_SHAPES = "api codec datasets domain fusion mapping mission perception pose_fit render wire"
BESIDE_THE_CORE = ("gausslite_calibration", "gausslite_sim", "gausslite_bench")
shape_checks.install([*(f"gausslite.{name}" for name in WITH_SHAPES.split()), *BESIDE_THE_CORE])

# a busy machine is no failure: no test depends on a time
hypothesis.settings.register_profile("untimed", deadline=None, suppress_health_check=[hypothesis.HealthCheck.too_slow])
hypothesis.settings.load_profile("untimed")

# a shell starts background jobs with SIGINT ignored; the tests of interrupts need Python's handler
signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session")
def shared_dir() -> Path:
    """Return the folder `shared` next to the project, with real sequences and models; skip the test without it."""
    folder = Path(__file__).resolve().parents[2] / "shared"
    if not folder.is_dir():
        pytest.skip(f"no real sequences and models here: {folder} is absent")
    return folder


@pytest.fixture(scope="session")
def postgres() -> Iterator[PostgresServer]:
    """Return a running PostgreSQL server; skip the test where it is not installed."""
    with postgres_server() as server:
        yield server
