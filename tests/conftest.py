"""Check the shapes in type annotations during every test, and locate optional data next to the project."""

import signal
from collections.abc import Iterator
from pathlib import Path

import hypothesis
import pytest
from support import shape_checks
from support.postgres_running import PostgresServer, postgres_server

WITH_SHAPES = "api codec datasets domain fusion mapping mission perception render wire"
BESIDE_THE_CORE = "bench calibration detectors evaluation export mcp places poses refinement render selection sim"
shape_checks.install(
    [f"gausslite.{name}" for name in WITH_SHAPES.split()] + [f"gausslite_{name}" for name in BESIDE_THE_CORE.split()]
)

# a busy machine is no failure: no test depends on a time
for _profile, _examples in (("not slow", 40), ("slow", 240)):
    hypothesis.settings.register_profile(
        _profile, deadline=None, suppress_health_check=[hypothesis.HealthCheck.too_slow], max_examples=_examples
    )

# a shell starts background jobs with SIGINT ignored; the tests of interrupts need Python's handler
signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_configure(config: pytest.Config) -> None:
    """Check properties on few examples, and on many with the slow tests."""
    hypothesis.settings.load_profile("not slow" if config.option.markexpr == "not slow" else "slow")


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Leave out modules of slow tests before they are imported, which takes each process seconds."""
    is_module = collection_path.suffix == ".py" and config.option.markexpr == "not slow"
    return (is_module and "\npytestmark = pytest.mark.slow" in collection_path.read_text()) or None


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Run all properties with the slow tests too, where they have many examples."""
    for item in items:
        if config.option.markexpr == "slow" and getattr(getattr(item, "obj", None), "is_hypothesis_test", False):
            item.add_marker(pytest.mark.slow)


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


@pytest.fixture
def fusion() -> Iterator[object]:
    """Return a fusion server in this process with its clients, a `fusion_running.RunningServer`."""
    from fusion_running import fusion_server

    with fusion_server() as running:
        yield running


@pytest.fixture
def robot() -> Iterator[object]:
    """Return an agent and its service in this process, an `agent_running.Agent`."""
    from agent_running import agent

    with agent() as running:
        yield running
