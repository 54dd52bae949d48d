"""The agent waits for its parser service, and ends the wait at once on SIGTERM."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from gausslite.domain.errors import TaskError, UnavailableError
from gausslite.domain.task import TaskGraph
from gausslite.task.rules import RuleParser
from gausslite_agent.parser_wait import WaitingParser

TASK = "Pick up the mug"


class LateParser:
    """A parser that is unavailable for the first calls."""

    def __init__(self, unavailable_calls: int) -> None:
        self.unavailable_calls = unavailable_calls

    def parse(self, text: str) -> TaskGraph:
        if self.unavailable_calls > 0:
            self.unavailable_calls -= 1
            raise UnavailableError("parser: connection refused")
        return RuleParser().parse(text)


def test_a_parser_that_starts_later_is_used() -> None:
    assert WaitingParser(LateParser(1)).parse(TASK) == RuleParser().parse(TASK)


def test_the_wait_ends_after_its_timeout_and_for_an_invalid_task() -> None:
    with pytest.raises(UnavailableError, match="refused"):
        WaitingParser(LateParser(99), timeout_s=0.0).parse(TASK)
    with pytest.raises(TaskError):
        WaitingParser(LateParser(0)).parse("!")


def test_stop_ends_the_wait() -> None:
    parser = WaitingParser(LateParser(99))
    threading.Timer(0.1, parser.stop).start()
    with pytest.raises(UnavailableError, match="refused"):
        parser.parse(TASK)


def test_a_real_agent_that_waits_for_its_parser_ends_on_sigterm(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "gausslite_agent", "--listen", f"unix:{tmp_path}/agent.sock"]
    command += ["--source", "sim:home", "--task", TASK, "--parser", "127.0.0.1:1"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stderr is not None
            while "retrying" not in process.stderr.readline():
                pass
            start_s = time.monotonic()
            process.send_signal(signal.SIGTERM)
            assert process.wait(20) == 2
            assert time.monotonic() - start_s < 15
            assert "refused" in process.stderr.read().lower()
        finally:
            process.kill()
