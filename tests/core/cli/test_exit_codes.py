"""Exit codes are those of docs/reference/commands.md, and a signal ends every long command with one line."""

import os
import re
import shlex
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from run_folders import write_run
from tiny_sequences import write_tum

from gausslite.cli.main import main
from gausslite.process import ROBOT_LOST, TASK_NOT_FOUND, end_quietly_while_starting

PAGE = Path(__file__).resolve().parents[3] / "docs" / "reference" / "commands.md"
ROWS = re.findall(r"^\| (\d+) \| .+ \| (?:`gausslite (.+)` )?\|$", PAGE.read_text(), re.MULTILINE)


@pytest.mark.parametrize(("code", "example"), [row for row in ROWS if row[1]])
def test_the_examples_of_the_page_have_the_stated_codes(
    code: str, example: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "notes.txt").write_text("a file")
    assert main(shlex.split(example)) == int(code)
    assert len(capsys.readouterr().err.splitlines()) == (1 if code == "2" else 0)


def test_a_reader_that_has_read_enough_ends_a_command_without_a_line() -> None:
    read_end, write_end = os.pipe()
    os.close(read_end)
    with os.fdopen(write_end, "w") as pipe:
        done = subprocess.run(
            [sys.executable, "-m", "gausslite", "parse", "Pick up the mug", "--json"],
            stdout=pipe,
            stderr=subprocess.PIPE,
            check=False,
        )
    assert (done.returncode, done.stderr) == (141, b"")


def test_wrong_options_have_the_code_of_wrong_input() -> None:
    with pytest.raises(SystemExit) as ended:
        main(["parse"])
    assert ended.value.code == 2


def test_a_misspelt_command_names_the_nearest_one(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["exprot", "run"])
    assert ended.value.code == 2
    assert capsys.readouterr().err == (
        "gausslite: argument COMMAND: invalid choice: 'exprot'; did you mean export?; see `gausslite --help`\n"
    )


@pytest.mark.parametrize(
    ("arguments", "program"),
    [(("parse", "Find the mug", "--jsn"), "gausslite parse"), (("bench", "parser", "--jsn"), "gausslite bench parser")],
)
def test_an_unknown_option_is_one_line_that_names_the_help_of_its_command(
    arguments: tuple[str, ...], program: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(list(arguments))
    assert ended.value.code == 2
    expected = f"{program}: unrecognized arguments: --jsn; did you mean --json?; see `{program} --help`\n"
    assert capsys.readouterr().err == expected


def test_the_page_lists_the_codes_of_signals() -> None:
    codes = {int(code) for code, _ in ROWS}
    of_signals = {128 + number for number in (signal.SIGINT, signal.SIGPIPE, signal.SIGTERM)}
    assert {0, 1, 2, TASK_NOT_FOUND, ROBOT_LOST} | of_signals == codes


class SignalAtOpen:
    """Raises a signal in this process when it first opens a file below a folder, in the middle of a command."""

    def __init__(self) -> None:
        self.folder: Path | None = None
        self.number = signal.SIGINT
        sys.addaudithook(self._watch)

    def _watch(self, event: str, arguments: tuple[object, ...]) -> None:
        if self.folder is None or event not in ("open", "os.scandir", "os.listdir"):
            return
        if str(arguments[0]).startswith(str(self.folder)):
            self.folder = None
            signal.raise_signal(self.number)


@pytest.fixture(scope="module")
def signal_at_open() -> SignalAtOpen:
    """Return the only hook: hooks cannot be removed."""
    return SignalAtOpen()


@pytest.fixture
def handlers_of_a_program() -> Iterator[None]:
    """Install the handlers as `gausslite` does, and restore those of pytest."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    end_quietly_while_starting("gausslite")
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


LONG_COMMANDS = {
    "map": ["map", "SEQUENCE", "--policy", "uniform", "--out", "OUT"],
    "eval": ["eval", "MAP", "SEQUENCE"],
    "calibrate": ["calibrate", "SEQUENCE"],
    "export": ["export", "MAP", "--to", "splat", "--out", "SPLAT"],
    "fuse": ["fuse", "MAP", "OTHER", "--out", "FUSED"],
    "report": ["report", "RUN", "--out", "OUT"],
    "objects": ["objects", "RUN"],
    "demo": ["demo", "--source", "SEQUENCE", "--task-a", "Find the mug", "--task-b", "Find the mug", "--out", "OUT"],
    "loop": ["bench", "loop", "SEQUENCE", "--policy", "uniform"],
}


@pytest.mark.parametrize(("number", "event"), [(signal.SIGINT, "interrupted"), (signal.SIGTERM, "terminated")])
@pytest.mark.parametrize("command", LONG_COMMANDS)
@pytest.mark.usefixtures("handlers_of_a_program")
def test_a_signal_ends_a_long_command_with_one_line(
    command: str,
    number: signal.Signals,
    event: str,
    tmp_path: Path,
    signal_at_open: SignalAtOpen,
    capsys: pytest.CaptureFixture[str],
) -> None:
    inputs = tmp_path / "inputs"
    inputs.mkdir()
    run = write_run(inputs / "run")
    places = {
        "SEQUENCE": write_tum(inputs / "room"),
        "MAP": run / "map.ply",
        "OTHER": write_run(inputs / "other") / "map.ply",
        "RUN": run,
        "OUT": tmp_path / "out",
        "SPLAT": tmp_path / "out.splat",
        "FUSED": tmp_path / "out.ply",
    }
    signal_at_open.folder, signal_at_open.number = inputs, number
    assert main([str(places.get(word, word)) for word in LONG_COMMANDS[command]]) == 128 + number
    assert signal_at_open.folder is None
    assert capsys.readouterr().err.splitlines() == [f"gausslite: {event}"]
