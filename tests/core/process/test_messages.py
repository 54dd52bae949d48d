"""Messages on stderr are one line without control characters."""

import logging

import pytest

from gausslite.cli.main import main
from gausslite.process import printable
from gausslite.wire.run_service import _OneLine


def test_names_with_newlines_and_escape_sequences_are_escaped(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["fuse", "a\n\x1b[31mb.ply", "c.ply", "--out", "d.ply"]) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert "a\\n\\x1b[31mb.ply" in line


def test_printable_text_is_unchanged() -> None:
    assert printable("Tür ‘8’ → µ") == "Tür ‘8’ → µ"
    assert printable("\udcff\t\u202e") == "\\udcff\\t\\u202e"


def test_logs_are_escaped() -> None:
    record = logging.LogRecord("x", logging.INFO, "x.py", 1, "agent %s", ("a\x1b[31m\nb",), None)
    assert _OneLine("%(message)s").format(record) == "agent a\\x1b[31m | b"
