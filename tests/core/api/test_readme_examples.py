"""The Python example of README.md runs as it is printed."""

import re
from pathlib import Path

import pytest

README = Path(__file__).resolve().parents[3] / "README.md"
MAX_LINES = 10


@pytest.mark.parametrize("frames", ["0:3", pytest.param("0:20", marks=pytest.mark.slow)])
def test_the_example_is_short_and_runs(
    frames: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("embreex", reason="simulated homes need the extra sim")
    [block] = re.findall(r"^```python\n(.*?)^```", README.read_text(), re.MULTILINE | re.DOTALL)
    assert "0:20" in block
    assert len([line for line in block.splitlines() if line]) <= MAX_LINES
    monkeypatch.chdir(tmp_path)
    exec(compile(block.replace("0:20", frames), str(README), "exec"), {})
    assert (tmp_path / "map.ply").is_file()
    assert re.fullmatch(r"\d+ Gaussians, \d+ of the task\n", capsys.readouterr().out)
