"""Every progress bar of the programs is made by cli/progress.py, so that all look and behave the same."""

import io
import sys
from pathlib import Path

import pytest

from gausslite.cli.progress import progress_bar

ROOT = Path(__file__).resolve().parents[3]


def test_only_one_module_creates_bars() -> None:
    sources = [path for folder in ("src", "services") for path in (ROOT / folder).rglob("*.py")]
    creating = [str(path.relative_to(ROOT)) for path in sources if "tqdm(" in path.read_text()]
    assert creating == ["src/gausslite/cli/progress.py"]


def test_a_bar_shows_its_label_and_count_on_stderr(monkeypatch: pytest.MonkeyPatch) -> None:
    stderr = io.StringIO()
    monkeypatch.setattr(sys, "stderr", stderr)
    with progress_bar(4, "mapping", "frame") as bar:
        bar.update(2)
    last = stderr.getvalue().replace("\r", "\n").strip().splitlines()[-1]
    assert last.startswith("mapping: ")
    assert "2/4" in last
