"""The Python examples of README.md run as they are printed."""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

README = Path(__file__).resolve().parents[3] / "README.md"
SERVER = "localhost:50052"
MAX_LINES = 10


def python_blocks() -> list[str]:
    return re.findall(r"^```python\n(.*?)^```", README.read_text(), re.MULTILINE | re.DOTALL)


@contextmanager
def fusion_server() -> Iterator[str]:
    """Run a fusion server with an empty map; yields its address."""
    with tempfile.TemporaryDirectory() as folder:
        address = f"unix:{folder}/fusion.sock"
        command = [sys.executable, "-m", "gausslite_fusion_server", "--listen", address]
        process = subprocess.Popen(command, stderr=subprocess.DEVNULL)
        try:
            import grpc

            with grpc.insecure_channel(address) as channel:
                grpc.channel_ready_future(channel).result(30)
            yield address
        finally:
            process.terminate()
            process.wait(20)


def test_examples_are_short() -> None:
    blocks = python_blocks()
    assert len(blocks) >= 4
    assert all(len([line for line in block.splitlines() if line]) <= MAX_LINES for block in blocks)


def test_examples_on_a_simulated_home_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("embreex", reason="simulated homes need the extra sim")
    monkeypatch.chdir(tmp_path)
    for block in python_blocks():
        if SERVER not in block:
            exec(compile(block, str(README), "exec"), {})
    assert (tmp_path / "map.ply").is_file()
    assert "Gaussians" in capsys.readouterr().out


def test_the_fusion_example_runs(capsys: pytest.CaptureFixture[str]) -> None:
    [block] = [block for block in python_blocks() if SERVER in block]
    with fusion_server() as address:
        exec(compile(block.replace(SERVER, address), str(README), "exec"), {})
    assert capsys.readouterr().out.startswith("revision")
