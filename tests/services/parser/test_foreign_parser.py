"""The parser service serves a parser that another distribution registers, with options of its own."""

import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

import pytest
from other_process import environment_with, run_python

from gausslite.wire.clients import ParserClient
from gausslite_agent.program import WaitingParser

MODULE = """
from dataclasses import dataclass
from gausslite.config.option import option
from gausslite.domain.task import TaskGraph

class FixedParser:
    def __init__(self, noun):
        self._noun = noun

    def parse(self, text):
        return TaskGraph("fixed", text, (self._noun,), (), ())

@dataclass(frozen=True, slots=True)
class FixedBackend:
    noun: str = option("mug", "what every task means", key="fixed-noun", needs="backend=fixed")

    def open(self):
        return FixedParser(self.noun)
"""


@pytest.fixture
def environment(tmp_path: Path) -> Mapping[str, str]:
    """Return the environment of a process in which the distribution is installed."""
    metadata = tmp_path / "fixed_parser-1.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: fixed-parser\nVersion: 1\n")
    (metadata / "entry_points.txt").write_text("[gausslite.parsers]\nfixed = fixed_parser:FixedBackend\n")
    (tmp_path / "fixed_parser.py").write_text(MODULE)
    return environment_with(tmp_path)


def test_a_parser_of_another_distribution_is_chosen_by_its_name(tmp_path: Path, environment: Mapping[str, str]) -> None:
    listen = f"unix:{tmp_path}/parser.sock"
    options = ("--backend", "fixed", "--fixed-noun", "cup")
    command = [sys.executable, "-m", "gausslite_parser", "--listen", listen, *options]
    with subprocess.Popen(command, env=environment) as process, ParserClient(listen) as client:
        try:
            assert WaitingParser(client).parse("Pick it up").targets == ("cup",)
        finally:
            process.terminate()


def test_an_option_of_another_parser_is_refused(environment: Mapping[str, str]) -> None:
    done = run_python("-m", "gausslite_parser", "--fixed-noun", "cup", environment=environment)
    assert done.returncode == 2
    assert "--fixed-noun: has an effect only with --backend fixed" in done.stderr
