"""Show how long work goes on: one bar with the figures a roboticist watches."""

from __future__ import annotations

import sys
import time
from types import TracebackType
from typing import Any

from tqdm import tqdm


def progress_bar(total: int, label: str, unit: str, row: int = 0) -> tqdm[Any]:
    """A bar on stderr, redrawn at once on a terminal; elsewhere a line every ten seconds."""
    on_terminal = sys.stderr.isatty()
    return tqdm(
        total=total,
        desc=label,
        unit=unit,
        position=row if on_terminal else 0,
        mininterval=0.2 if on_terminal else 10.0,
        dynamic_ncols=on_terminal,
        file=sys.stderr,
    )


class MappingBar:
    """A progress bar over frames, with the figures."""

    def __init__(self, total: int, label: str = "map", row: int = 0) -> None:
        self._bar = progress_bar(total, label, "frame", row)
        self._start = time.monotonic()

    def __enter__(self) -> MappingBar:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Leave the last figures on the screen."""
        self._bar.close()

    def show(self, done: int, gaussians: int, roi_share: float, uplink_bytes: int | None = None) -> None:
        """Move to `done` frames and show the figures."""
        hz = done / max(time.monotonic() - self._start, 1e-9)
        figures = f"{gaussians / 1e3:.1f}k Gaussians, ROI {roi_share:.1%}, {hz:.1f} Hz"
        if uplink_bytes is not None:
            figures += f", sent {uplink_bytes / 1e6:.2f} MB"
        self._bar.set_postfix_str(figures, refresh=False)
        self._bar.update(done - self._bar.n)
