"""A program interrupted during its start prints one line and returns a known code."""

import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest
from other_process import run_python

from gausslite.process import raise_interrupts


@pytest.mark.parametrize(
    ("module", "arguments", "imported", "number"),
    [
        ("gausslite", ["demo", "--help"], "argparse", signal.SIGTERM),
        ("gausslite", ["map", "--help"], "numpy", signal.SIGINT),
        ("gausslite_agent", [], "asyncio", signal.SIGINT),
        ("gausslite_agent", [], "cv2", signal.SIGTERM),
        ("gausslite_fusion_server", [], "numpy", signal.SIGTERM),
        ("gausslite_parser", [], "grpc", signal.SIGINT),
    ],
)
def test_a_signal_during_the_start_causes_no_traceback(
    module: str, arguments: Sequence[str], imported: str, number: signal.Signals
) -> None:
    listen = ["--listen", "127.0.0.1:0"] if not arguments else []
    command = [sys.executable, "-X", "importtime", "-m", module, *listen, *arguments]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        lines = []
        for line in process.stderr:
            lines.append(line)
            if line.rpartition("|")[2].strip() == imported:
                break
        process.send_signal(number)
        lines += process.stderr.readlines()
        code = process.wait(60)
    messages = [line for line in lines if not line.startswith("import time:")]
    # on a busy machine the service may already run, or the help may be complete, before the signal arrives
    assert code in (128 + number, 0), messages
    assert not any("Traceback" in line for line in messages)
    if code:
        assert messages[-1] == f"{module.replace('_', '-')}: interrupted while starting\n"


def test_a_started_program_keeps_its_own_handlers() -> None:
    def chosen(_number: int, _frame: object) -> None:
        raise AssertionError("nothing is sent here")

    before = signal.signal(signal.SIGTERM, chosen)
    try:
        raise_interrupts()
        assert signal.getsignal(signal.SIGTERM) is chosen
    finally:
        signal.signal(signal.SIGTERM, before)


FAILURES = {
    "protobuf": "from google.protobuf import runtime_version as v\nraise v.VersionError('gencode 7 runtime 5. More')",
    "protobuf without the check": "from google.protobuf import no_such_module",
    "grpcio": "raise RuntimeError('The grpc package installed is at version 1, but the generated code depends on 2')",
}


@pytest.mark.parametrize("name", FAILURES)
def test_a_library_older_than_its_generated_code_gives_one_line(tmp_path: Path, name: str) -> None:
    (tmp_path / "program.py").write_text(FAILURES[name])
    code = "import sys\nfrom gausslite.process import run_program\nsys.exit(run_program('gausslite', 'program'))"
    done = run_python("-c", code, cwd=tmp_path)
    [line] = done.stderr.splitlines()
    assert done.returncode == 2
    assert f"pip install --upgrade {name.split()[0]} (" in line


def test_compiled_modules_that_are_missing_give_one_line(tmp_path: Path) -> None:
    (tmp_path / "program.py").write_text("from gausslite.codec import _not_compiled")
    code = "import sys\nfrom gausslite.process import run_program\nsys.exit(run_program('gausslite', 'program'))"
    done = run_python("-c", code, cwd=tmp_path)
    [line] = done.stderr.splitlines()
    assert (done.returncode, "install GaussLite again with it" in line, "_not_compiled" in line) == (2, True, True)


def test_another_error_of_an_import_keeps_its_traceback(tmp_path: Path) -> None:
    (tmp_path / "program.py").write_text("import no_such_module")
    code = "from gausslite.process import run_program\nrun_program('gausslite', 'program')"
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, timeout=60, capture_output=True, check=False)
    assert (done.returncode, b"ModuleNotFoundError" in done.stderr) == (1, True)


def test_after_the_start_both_signals_raise() -> None:
    code = (
        "import signal\n"
        "from gausslite.process import Terminated, end_quietly_while_starting, raise_interrupts\n"
        "end_quietly_while_starting('x')\nraise_interrupts()\n"
        "for number, expected in ((signal.SIGINT, KeyboardInterrupt), (signal.SIGTERM, Terminated)):\n"
        "    try:\n        signal.raise_signal(number)\n"
        "    except KeyboardInterrupt as interrupt:\n        assert type(interrupt) is expected\n"
        "    else:\n        raise SystemExit(1)\n"
    )
    assert subprocess.run([sys.executable, "-c", code], timeout=60).returncode == 0
