"""A program that is interrupted while it starts ends with one line and a known code; its imports tell where it is."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Sequence

import pytest

from gausslite.interrupts import started


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize(
    ("module", "arguments", "imported"),
    [
        ("gausslite", ["demo", "--help"], "argparse"),
        ("gausslite", ["map", "--help"], "numpy"),
        ("gausslite_agent", [], "asyncio"),
        ("gausslite_agent", [], "cv2"),
        ("gausslite_fusion_server", [], "numpy"),
        ("gausslite_parser", [], "grpc"),
    ],
)
def test_no_traceback_whenever_the_signal_comes(
    module: str, arguments: Sequence[str], imported: str, number: signal.Signals
) -> None:
    listen = ["--listen", "127.0.0.1:0"] if not arguments else []
    command = [sys.executable, "-X", "importtime", "-m", module, *listen, *arguments]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        said = []
        for line in process.stderr:
            said.append(line)
            if line.rpartition("|")[2].strip() == imported:
                break
        process.send_signal(number)
        said += process.stderr.readlines()
        code = process.wait(60)
    last_words = [line for line in said if not line.startswith("import time:")]
    # on a busy machine the signal may find a service that runs already, or a help that is printed
    assert code in (128 + number, 0), last_words
    assert not any("Traceback" in line for line in last_words)
    if code:
        assert last_words[-1] == f"{module.replace('_', '-')}: interrupted while starting\n"


def test_a_program_that_has_started_keeps_the_handlers_it_chose() -> None:
    def chosen(_number: int, _frame: object) -> None:
        raise AssertionError("nothing is sent here")

    before = signal.signal(signal.SIGTERM, chosen)
    try:
        started()
        assert signal.getsignal(signal.SIGTERM) is chosen
    finally:
        signal.signal(signal.SIGTERM, before)


def test_a_start_that_ended_gives_the_signals_back() -> None:
    code = (
        "import signal\nfrom gausslite.interrupts import end_quietly_while_starting, started\n"
        "end_quietly_while_starting('x')\nstarted()\n"
        "assert signal.getsignal(signal.SIGINT) is signal.default_int_handler\n"
        "assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL\n"
    )
    assert subprocess.run([sys.executable, "-c", code], timeout=60).returncode == 0
