"""Every progress bar of the programs is made by cli/progress.py, so that all look and behave the same."""

import io
import sys
from pathlib import Path

import pytest

from gausslite.cli.progress import MappingBar, progress_bar
from gausslite.mission.frame_scheduler import FrameTiming
from gausslite.mission.runner import MissionTotals
from gausslite.mission.task_mapper import FrameOutcome

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


def test_the_rate_of_a_mapping_bar_is_that_of_the_summary(monkeypatch: pytest.MonkeyPatch) -> None:
    stderr, totals = io.StringIO(), MissionTotals()
    monkeypatch.setattr(sys, "stderr", stderr)
    with MappingBar(2) as bar:
        for seconds, skipped in ((0.5, None), (0.25, "too far")):
            timing = FrameTiming(seconds, {}, frozenset(), False)
            outcome = FrameOutcome(0, 1, 10, 0.0, timing, skipped)
            totals.add(outcome)
            bar.count(outcome)
    last = stderr.getvalue().replace("\r", "\n").strip().splitlines()[-1]
    assert f"{totals.hz:.1f} Hz" in last
    assert totals.hz == 2.0
    assert "frame/s" not in last
