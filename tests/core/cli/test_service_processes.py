"""A process group owns a child as soon as it exists, and ends all children."""

import signal
import subprocess
from pathlib import Path

import pytest

from gausslite_demo.services import ProcessGroup


class InterruptedStart(subprocess.Popen[bytes]):
    """A real process whose parent receives SIGINT right after its start."""

    def __init__(self, *arguments: object, **options: object) -> None:
        super().__init__(*arguments, **options)  # type: ignore[call-overload]
        signal.raise_signal(signal.SIGINT)


def test_an_interrupt_during_a_start_does_not_orphan_the_child(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    group = ProcessGroup(tmp_path)
    monkeypatch.setattr(subprocess, "Popen", InterruptedStart)
    with pytest.raises(KeyboardInterrupt), group:
        group.start("sleeper", "timeit", ("-n", "1", "-s", "import time", "time.sleep(60)"))
    assert len(group.services) == 1
    assert group.services[0].process.returncode == -signal.SIGTERM


def test_a_child_does_not_inherit_option_variables(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GAUSSLITE_OUT", "elsewhere")
    monkeypatch.setenv("GAUSSLITE_SIMD", "avx2")
    show = "import os; print(sorted(name for name in os.environ if name.startswith('GAUSSLITE_')))"
    with ProcessGroup(tmp_path) as group:
        child = group.start("child", "timeit", ("-n", "1", "-r", "1", show))
        child.process.wait(60)
    assert child.log.read_text().splitlines()[0] == "['GAUSSLITE_SIMD']"
