"""The agent waits for its parser service, and ends the wait at once on SIGTERM."""

import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from serving import serving

from gausslite.domain.errors import TaskError, UnavailableError
from gausslite.domain.task import TaskGraph
from gausslite.wire.clients import ParserClient
from gausslite_agent.program import WaitingParser
from gausslite_language.rules import RuleParser
from gausslite_parser.program import parser_service

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
    pytest.raises(UnavailableError, WaitingParser(LateParser(99), timeout_s=0.0).parse, TASK).match("refused")
    pytest.raises(TaskError, WaitingParser(LateParser(0)).parse, "!")


def test_stop_ends_the_wait() -> None:
    parser = WaitingParser(LateParser(99))
    threading.Timer(0.1, parser.stop).start()
    with pytest.raises(UnavailableError, match=r"stopped while waiting for the parser service: .* refused"):
        parser.parse(TASK)


class SilentParser:
    """A parser that accepts a task and does not answer until the end of the test."""

    def __init__(self) -> None:
        self.called, self.end = threading.Event(), threading.Event()

    def parse(self, text: str) -> TaskGraph:
        self.called.set()
        self.end.wait()
        return RuleParser().parse(text)


def test_stop_cancels_a_call_that_the_service_does_not_answer() -> None:
    silent = SilentParser()
    with serving([parser_service(silent)]) as server, ParserClient(server.address, deadline_s=3600.0) as client:
        waiting = WaitingParser(client, cancel=client.close)
        threading.Thread(target=lambda: silent.called.wait() and waiting.stop()).start()
        try:
            with pytest.raises(UnavailableError, match=r"^stopped while waiting for the parser service$"):
                waiting.parse(TASK)
        finally:
            silent.end.set()


@pytest.mark.slow
def test_a_real_agent_that_waits_for_its_parser_ends_on_sigterm(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "gausslite_agent", "--listen", f"unix:{tmp_path}/agent.sock"]
    command += ["--source", "sim:home", "--task", TASK, "--parser", "127.0.0.1:1"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stderr is not None
            while "retrying" not in process.stderr.readline():
                pass
            process.send_signal(signal.SIGTERM)
            assert process.wait(20) == 2
            assert "refused" in process.stderr.read().lower()
        finally:
            process.kill()
