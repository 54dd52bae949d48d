"""Install the example packages from their folders, without network, for a process that the test starts."""

import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def install(example: str, folder: Path) -> None:
    """Install `examples/<example>` into a folder by pip, built from a copy: setuptools writes beside its sources."""
    copied = folder.with_name(f"{folder.name}-{example}")
    shutil.copytree(ROOT / "examples" / example, copied)
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-index"]
    command = [*pip, "--no-deps", "--no-build-isolation", "--target", str(folder), str(copied)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
