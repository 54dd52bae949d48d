"""Draw curves as a picture: a panel for each experiment, a line for each contender."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import UInt8
from numpy import ndarray

_SIZE_PX = (640, 360)
_MARGIN_PX = 48
_PAPER, _INK, _GRID = (24, 24, 24), (235, 235, 235), (60, 60, 60)
_COLOURS = ((255, 208, 0), (240, 90, 90), (90, 200, 250), (140, 230, 140))
_TICKS = 5

Curves = Mapping[str, Sequence[tuple[float, float]]]
"""Points (x, y) by the name of their line; each line has one at least."""


def plot_panels(panels: Mapping[str, Curves], x_label: str, y_label: str) -> UInt8[ndarray, "H W 3"]:
    """The panels one below the other, each with its title, axes and legend."""
    return np.concatenate([_panel(title, curves, x_label, y_label) for title, curves in panels.items()])


def _panel(title: str, curves: Curves, x_label: str, y_label: str) -> UInt8[ndarray, "h w 3"]:
    import cv2

    width, height = _SIZE_PX
    image = np.full((height, width, 3), _PAPER, np.uint8)
    points = np.array([point for line in curves.values() for point in line], np.float64)
    low, high = points.min(axis=0), points.max(axis=0)
    span = np.where(high > low, high - low, 1.0)
    corner, extent = np.array([_MARGIN_PX, height - _MARGIN_PX]), np.array([width - 2 * _MARGIN_PX, height - 100])

    def place(point: Sequence[float]) -> tuple[int, int]:
        x, y = corner + extent * (np.array(point) - low) / span * (1, -1)
        return round(x), round(y)

    for share in np.linspace(0.0, 1.0, _TICKS):
        x, y = low + share * span
        cv2.line(image, place((x, low[1])), place((x, low[1] + span[1])), _GRID, 1)
        cv2.line(image, place((low[0], y)), place((low[0] + span[0], y)), _GRID, 1)
        _write(image, f"{x:.1f}", (place((x, low[1]))[0] - 10, height - _MARGIN_PX + 16))
        _write(image, f"{y:.1f}", (6, place((low[0], y))[1] + 4))
    for (name, line), colour in zip(curves.items(), _COLOURS, strict=False):
        path = np.array([place(point) for point in line], np.int32)
        cv2.polylines(image, [path], False, colour, 2, cv2.LINE_AA)
        for point in path:
            cv2.circle(image, point.tolist(), 3, colour, -1, cv2.LINE_AA)
        at = (_MARGIN_PX + 170 * list(curves).index(name), 40)
        cv2.line(image, (at[0], at[1] - 4), (at[0] + 18, at[1] - 4), colour, 2)
        _write(image, name, (at[0] + 24, at[1]))
    _write(image, f"{title}: {y_label}", (6, 18))
    _write(image, x_label, (width - 10 - 7 * len(x_label), height - 10))
    return image


def _write(image: UInt8[ndarray, "h w 3"], text: str, at: tuple[int, int]) -> None:
    import cv2

    cv2.putText(image, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.42, _INK, 1, cv2.LINE_AA)
