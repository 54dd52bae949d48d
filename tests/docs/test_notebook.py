"""The notebook runs from its first to its last cell, and shows pictures and scores."""

import json
import os
import shutil
import subprocess
import sysconfig
from pathlib import Path

import pytest

pytest.importorskip("nbclient", reason="the extra `test` is not installed")
pytest.importorskip("ipykernel", reason="the extra `test` is not installed")
pytest.importorskip("embreex", reason="the simulated home needs the extra `sim`")

pytestmark = pytest.mark.slow

NOTEBOOK = Path(__file__).resolve().parents[2] / "examples" / "first_map.ipynb"


def test_the_notebook_runs(tmp_path: Path) -> None:
    notebook = Path(shutil.copy(NOTEBOOK, tmp_path))  # it writes its map next to itself
    command = [Path(sysconfig.get_path("scripts")) / "jupyter-execute", "--inplace", notebook]
    environment = {**os.environ, "JUPYTER_CONFIG_DIR": str(tmp_path), "IPYTHONDIR": str(tmp_path)}
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=280)
    assert done.returncode == 0, done.stderr
    outputs = [output for cell in json.loads(notebook.read_text())["cells"] for output in cell.get("outputs", [])]
    printed = "".join("".join(output.get("text", "")) for output in outputs)
    assert sum("image/jpeg" in output.get("data", {}) for output in outputs) == 2
    assert "dB in the region" in printed
    assert "Gaussians read back" in printed
