"""Line plots of benchmark results: one panel per experiment, one line per contender."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path

from gausslite.codec.state_file import write_atomic
from gausslite.domain.errors import InvalidInputError

_PANEL_SIZE_IN = (6.4, 3.6)
_DPI = 100

Curves = Mapping[str, Sequence[tuple[float, float]]]
"""Points (x, y) of each line by its name."""


def require_matplotlib() -> None:
    """Raise InvalidInputError without the extra `plots`; call it before a long benchmark."""
    try:
        import matplotlib  # noqa: F401
    except ImportError:
        raise InvalidInputError("plots: need matplotlib; install it with: pip install 'gausslite[plots]'") from None


def write_curves(path: Path, panels: Mapping[str, Curves], x_label: str, y_label: str) -> None:
    """Write a PNG with the titled panels below each other. Raises InvalidInputError, StorageError."""
    require_matplotlib()
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    width_in, height_in = _PANEL_SIZE_IN
    figure = Figure(figsize=(width_in, height_in * len(panels)), dpi=_DPI, layout="constrained")
    for number, (title, curves) in enumerate(panels.items(), start=1):
        axes = figure.add_subplot(len(panels), 1, number)
        for name, points in curves.items():
            axes.plot([x for x, _ in points], [y for _, y in points], marker="o", markersize=3, label=name)
        axes.set(title=title, xlabel=x_label, ylabel=y_label)
        axes.grid(alpha=0.3)
        axes.legend()
    buffer = io.BytesIO()
    FigureCanvasAgg(figure)
    figure.savefig(buffer, format="png")
    write_atomic(path, buffer.getvalue())
