"""A real shell with the printed script completes commands, options, choices and files."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from gausslite.cli.main import main

pytest.importorskip("shtab", reason="completion needs the extra `completion`")


@pytest.fixture(scope="module")
def bash_script(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("completion") / "gausslite.bash"
    path.write_text(script("bash"))
    return path


def script(shell: str, *program: str) -> str:
    import contextlib
    import io

    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        assert main(["completion", shell, *program]) == 0
    return printed.getvalue()


def completions(bash_script: Path, folder: Path, *words: str, program: str = "gausslite") -> set[str]:
    """Return what bash offers for the last word, by the function that it would call at a press of Tab."""
    commands = """
        source "$1"; name="$2"; shift 2
        COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1)); COMP_LINE="$*"; COMP_POINT=${#COMP_LINE}
        compopt() { :; }
        specification=$(complete -p "$name") || exit 9
        function=$(sed -E 's/.*-F ([^ ]+).*/\\1/' <<< "$specification")
        "$function" "$name" "${COMP_WORDS[COMP_CWORD]}" "${COMP_WORDS[COMP_CWORD-1]}"
        printf '%s\\n' "${COMPREPLY[@]}"
    """
    command = ["bash", "--norc", "-c", commands, "bash", str(bash_script), program, program, *words]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=30)
    assert (done.returncode, done.stderr) == (0, "")
    return {line.strip() for line in done.stdout.splitlines() if line.strip()}


@pytest.mark.skipif(shutil.which("bash") is None, reason="needs bash")
def test_bash_completes_commands_options_choices_and_files(bash_script: Path, tmp_path: Path) -> None:
    (tmp_path / "kitchen.ply").touch()
    assert completions(bash_script, tmp_path, "ma") == {"map"}
    assert {"doctor", "demo"} <= completions(bash_script, tmp_path, "d")
    assert {"--max-gaussians"} == completions(bash_script, tmp_path, "map", "--max-g")
    assert completions(bash_script, tmp_path, "export", "--to", "sp") == {"splat", "spz"}
    assert completions(bash_script, tmp_path, "bench", "ras") == {"raster"}
    assert completions(bash_script, tmp_path, "completion", "") >= {"bash", "zsh", "fish"}
    assert "kitchen.ply" in completions(bash_script, tmp_path, "eval", "kit")
    assert completions(bash_script, tmp_path, "map", "--print-c") == {"--print-config"}
    assert "kitchen.ply" in completions(bash_script, tmp_path, "bench", "raster", "--config", "kit")


@pytest.mark.skipif(shutil.which("bash") is None, reason="needs bash")
@pytest.mark.parametrize(
    ("program", "typed", "option"),
    [
        ("gausslite-agent", "--hand", "--handover"),
        ("gausslite-fusion-server", "--max-miss", "--max-missions"),
        ("gausslite-fusion-server", "check", "check-claims"),
        ("gausslite-fusion-server", "--print-c", "--print-config"),
        ("gausslite-parser", "--llm-u", "--llm-url"),
    ],
)
def test_bash_completes_the_options_of_the_service_programs(
    program: str, typed: str, option: str, tmp_path: Path
) -> None:
    path = tmp_path / "program.bash"
    path.write_text(script("bash", program))
    assert completions(path, tmp_path, typed, program=program) == {option}


@pytest.mark.parametrize("shell", ["zsh", "fish"])
def test_the_scripts_of_other_shells_are_valid_where_the_shell_is_installed(shell: str, tmp_path: Path) -> None:
    path = tmp_path / f"gausslite.{shell}"
    path.write_text(script(shell))
    assert "--max-gaussians" in path.read_text() or "-l max-gaussians" in path.read_text()
    if shutil.which(shell) is None:
        pytest.skip(f"{shell} is not installed: only the text of its script was checked")
    assert subprocess.run([shell, "-n", str(path)], timeout=30).returncode == 0
