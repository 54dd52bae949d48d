"""Run Python in another process, with packages that it also finds, or does not see."""

import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path


def environment_with(folder: Path, **more: str) -> Mapping[str, str]:
    """Return the environment of a process that also finds the packages in the folder, with more variables."""
    paths = [str(folder), *filter(None, [os.environ.get("PYTHONPATH")])]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(paths), **more}


def environment_without(*packages: str) -> Mapping[str, str]:
    """Return the environment of a process that does not see these packages."""
    return environment_with(Path(__file__).parent / "without_extras", HIDDEN_PACKAGES=",".join(packages))


def run_python(
    *arguments: object, environment: Mapping[str, str] | None = None, cwd: Path | None = None, timeout_s: float = 120
) -> subprocess.CompletedProcess[str]:
    """Return the output and the code of Python with these arguments."""
    command = [sys.executable, *map(str, arguments)]
    return subprocess.run(
        command, env=environment, cwd=cwd, capture_output=True, text=True, timeout=timeout_s, check=False
    )
