"""Show how long work goes on: one bar with the figures a roboticist watches."""

from __future__ import annotations

import sys
import time
from types import TracebackType


class MappingBar:
    """A progress bar over frames. Draws on a terminal; elsewhere it prints a line every few seconds."""

    def __init__(self, total: int, label: str = "map", row: int = 0) -> None:
        from tqdm import tqdm

        on_terminal = sys.stderr.isatty()
        self._bar = tqdm(
            total=total,
            desc=label,
            unit="frame",
            position=row if on_terminal else 0,
            mininterval=0.2 if on_terminal else 10.0,
            dynamic_ncols=on_terminal,
            file=sys.stderr,
        )
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
