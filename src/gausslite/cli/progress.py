"""Show the progress of long work: a bar with the figures of mapping."""

from __future__ import annotations

import sys
from typing import Any

from tqdm import tqdm

from gausslite.mission.runner import MissionTotals
from gausslite.mission.task_mapper import FrameOutcome
from gausslite.process import printable, size_text

_TERMINAL_INTERVAL_S, _LOG_INTERVAL_S = 0.2, 10.0
_WITHOUT_RATE = "{l_bar}{bar}| {n_fmt}/{total_fmt} [{elapsed}<{remaining}{postfix}]"
"""Its own rate counts also the reading of files: beside those of the figures it would contradict them."""


def progress_bar(total: int, label: str, unit: str, row: int = 0) -> tqdm[Any]:
    """Return a bar on stderr; if stderr is not a terminal, it writes one line every ten seconds."""
    on_terminal = sys.stderr.isatty()
    return tqdm(
        total=total,
        desc=printable(label),
        unit=unit,
        position=row if on_terminal else 0,
        mininterval=_TERMINAL_INTERVAL_S if on_terminal else _LOG_INTERVAL_S,
        dynamic_ncols=on_terminal,
        bar_format=_WITHOUT_RATE,
        file=sys.stderr,
    )


def print_above_bar(line: str) -> None:
    """Write a line to stderr without breaking a progress bar."""
    tqdm.write(printable(line), file=sys.stderr)


class MappingBar:
    """A progress bar over frames, with the figures of the map; the rate is that of a run's summary."""

    def __init__(self, total: int, label: str = "map", row: int = 0) -> None:
        self._bar = progress_bar(total, label, "frame", row)
        self._totals = MissionTotals()

    def __enter__(self) -> MappingBar:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Stop updating; the last figures stay visible."""
        self._bar.close()

    def count(self, outcome: FrameOutcome) -> None:
        """Advance by one frame and show its figures."""
        self._totals.add(outcome)
        self.show(int(self._bar.n) + 1, outcome.gaussians, outcome.roi_share, self._totals.hz)

    def show(self, done: int, gaussians: int, roi_share: float, hz: float, uplink_bytes: int | None = None) -> None:
        """Set the number of frames and show the figures; hz: mapped frames per second of their processing."""
        figures = f"{gaussians / 1e3:.1f}k Gaussians, ROI {roi_share:.1%}, {hz:.1f} Hz"
        if uplink_bytes is not None:
            figures += f", sent {size_text(uplink_bytes)}"
        self._bar.set_postfix_str(figures, refresh=False)
        self._bar.update(done - self._bar.n)
