"""The sanitizer script reports a wrong argument or a missing Python in one line."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

SCRIPT = Path(__file__).resolve().parents[3] / "tools" / "sanitize.sh"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "sanitize: expected address or thread, got ''"),
        (["memory"], "sanitize: expected address or thread, got 'memory'"),
        (["address"], "sanitize: no such Python: python3"),
        (["thread", "snake"], "sanitize: no such Python: snake"),
    ],
)
def test_a_wrong_argument_or_missing_python_is_reported_in_one_line(
    arguments: list[str], message: str, tmp_path: Path
) -> None:
    bash, dirname = shutil.which("bash"), shutil.which("dirname")
    assert bash is not None
    assert dirname is not None
    (tmp_path / "dirname").symlink_to(dirname)
    command = [bash, str(SCRIPT), *arguments]
    result = subprocess.run(command, env={"PATH": str(tmp_path)}, capture_output=True, text=True, timeout=60)
    assert (result.returncode, result.stderr) == (1, f"{message}\n")
