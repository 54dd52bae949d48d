"""Children are noted before an interrupt may act, and all of them end with the group."""

from __future__ import annotations

import signal
import subprocess
from pathlib import Path

import pytest

from gausslite.cli.processes import ProcessGroup


class InterruptedBirth(subprocess.Popen[bytes]):
    """A real process whose parent is interrupted the moment it is born."""

    def __init__(self, *arguments: object, **options: object) -> None:
        super().__init__(*arguments, **options)  # type: ignore[call-overload]
        signal.raise_signal(signal.SIGINT)


def test_an_interrupt_while_a_child_is_born_does_not_orphan_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    group = ProcessGroup(tmp_path)
    monkeypatch.setattr(subprocess, "Popen", InterruptedBirth)
    with pytest.raises(KeyboardInterrupt), group:
        group.start("sleeper", "timeit", ("-n", "1", "-s", "import time", "time.sleep(60)"))
    assert len(group.services) == 1
    assert group.services[0].process.returncode == -signal.SIGTERM
