"""A plug-in of others that is broken, or takes a name of the core, gives one line and stops no other command."""

import subprocess
from collections.abc import Mapping
from pathlib import Path

import pytest
from other_process import environment_with, run_python

pytestmark = pytest.mark.slow

ENTRY_POINTS = """
[gausslite.commands]
broken = broken_plugin:COMMAND
other = other_plugin:COMMAND
map = other_plugin:COMMAND

[gausslite.detectors]
broken = broken_plugin:READER
"""


@pytest.fixture
def environment(tmp_path: Path) -> Mapping[str, str]:
    """Return the environment of a process that has the distribution of the broken plug-ins."""
    (tmp_path / "broken_plugin-1.dist-info").mkdir()
    (tmp_path / "broken_plugin-1.dist-info" / "METADATA").write_text("Name: broken-plugin\nVersion: 1\n")
    (tmp_path / "broken_plugin-1.dist-info" / "entry_points.txt").write_text(ENTRY_POINTS)
    (tmp_path / "broken_plugin.py").write_text("raise RuntimeError('no licence')\n")
    (tmp_path / "other_plugin.py").write_text("COMMAND = print\n")
    return environment_with(tmp_path, COLUMNS="200")


def run(environment: Mapping[str, str], *arguments: str) -> subprocess.CompletedProcess[str]:
    return run_python("-m", "gausslite", *arguments, environment=environment)


def test_a_broken_plugin_is_one_line_where_it_is_used(environment: Mapping[str, str], tmp_path: Path) -> None:
    listed = run(environment, "--help")
    assert listed.returncode == 0
    assert "map a sequence for a task" in listed.stdout
    reasons = {"broken": "the package broken_plugin cannot be loaded: RuntimeError('no licence')", "other": "Command"}
    for name, reason in reasons.items():
        used = run(environment, name)
        assert (used.returncode, len(used.stderr.splitlines())) == (2, 1), used.stderr
        assert f"gausslite: {name}: " in used.stderr
        assert reason in used.stderr
    (tmp_path / "detector.onnx").write_bytes(b"")
    detector = "--detector", str(tmp_path / "detector.onnx"), "--task", "Find the mug", "--out", str(tmp_path / "out")
    used = run(environment, "map", "sim:home?frames=2&size=32x24", *detector)
    assert used.returncode == 2
    assert "cannot be loaded: RuntimeError('no licence')" in used.stderr.splitlines()[-1]
