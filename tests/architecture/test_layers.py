"""The rooms of ARCHITECTURE.md know each other only downwards."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


def test_import_rules_hold() -> None:
    pytest.importorskip("importlinter", reason="import-linter comes with the dev extra")
    done = subprocess.run(
        [sys.executable, "-c", "from importlinter.cli import lint_imports_command; lint_imports_command()"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.parametrize(
    "module",
    [
        "gausslite.cli.main",
        "gausslite.domain.frame",
        "gausslite.mission.task_mapper",
        "gausslite.perception.relevance_estimator",
        "gausslite.fusion.vote",
        "gausslite.wire.clients",
    ],
)
def test_importing_a_room_loads_nothing_heavy(module: str) -> None:
    heavy = ("torch", "onnxruntime", "trimesh", "matplotlib", "scipy")
    code = f"import sys, {module}; print(*[m for m in {heavy!r} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == []


def test_help_lists_every_command_without_numpy() -> None:
    code = (
        "import sys\nfrom gausslite.cli.main import main\n"
        "try:\n    main(['--help'])\nexcept SystemExit as end:\n    assert end.code == 0\n"
        "assert 'numpy' not in sys.modules"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    for command in ("map", "demo", "parse", "eval", "fuse", "models", "bench"):
        assert command in done.stdout
