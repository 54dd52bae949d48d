"""Real shells with the printed scripts complete commands, options, choices and files."""

from __future__ import annotations

import contextlib
import io
from pathlib import Path

import pytest
from shell_completion import completions

from gausslite.cli.main import main

pytest.importorskip("shtab", reason="completion needs the extra `completion`")

SHELLS = ("bash", "zsh", "fish")


def script(shell: str, *program: str) -> str:
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        assert main(["completion", shell, *program]) == 0
    return printed.getvalue()


@pytest.mark.parametrize("shell", SHELLS)
def test_commands_options_choices_and_files_are_completed(shell: str, tmp_path: Path) -> None:
    (tmp_path / "kitchen.ply").touch()
    expected = {
        "ma": {"map"},
        "d": {"doctor", "demo"},
        "map --max-g": {"--max-gaussians"},
        "export --to sp": {"splat", "spz"},
        "bench ras": {"raster"},
        "completion ": {"bash", "zsh", "fish"},
        "eval kit": {"kitchen.ply"},
        "map --print-c": {"--print-config"},
        "bench raster --config kit": {"kitchen.ply"},
    }
    offered = completions(shell, script(shell), [f"gausslite {typed}" for typed in expected], tmp_path)
    assert dict(zip(expected, offered, strict=True)) == expected


@pytest.mark.parametrize("shell", SHELLS)
@pytest.mark.parametrize(
    ("program", "expected"),
    [
        ("gausslite-agent", {"--hand": {"--handover"}}),
        (
            "gausslite-fusion-server",
            {"--max-miss": {"--max-missions"}, "check": {"check-claims"}, "--print-c": {"--print-config"}},
        ),
        ("gausslite-parser", {"--llm-u": {"--llm-url"}}),
    ],
)
def test_options_of_the_service_programs_are_completed(
    shell: str, program: str, expected: dict[str, set[str]], tmp_path: Path
) -> None:
    offered = completions(shell, script(shell, program), [f"{program} {typed}" for typed in expected], tmp_path)
    assert dict(zip(expected, offered, strict=True)) == expected
