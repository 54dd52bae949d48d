"""The printed script has the commands and the options of each program."""

from __future__ import annotations

import re

import pytest

from gausslite.cli.main import main

pytest.importorskip("shtab", reason="completion needs the extra `completion`")


@pytest.mark.parametrize(
    ("program", "words"),
    [
        ("gausslite", {"doctor", "--max-gaussians", "--print-config"}),
        ("gausslite-agent", {"--listen"}),
        ("gausslite-fusion-server", {"--voxel-size", "verify"}),
        ("gausslite-parser", {"--listen"}),
    ],
)
def test_the_script_for_bash_has_the_words_of_a_program(
    program: str, words: set[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["completion", "bash", program]) == 0
    script = capsys.readouterr().out
    assert "complete -" in script
    assert words <= set(re.findall(r"[\w-]+", script))
