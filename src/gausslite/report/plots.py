"""Draw bars and lines as SVG."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from xml.etree.ElementTree import Element

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.report.elements import element, styled

_WIDTH, _HEIGHT = 460.0, 200.0
_LEFT, _RIGHT, _TOP, _BOTTOM = 58.0, 10.0, 10.0, 34.0
_MAX_POINTS = 400
_TICKS = 4
_STEPS = (1.0, 2.0, 2.5, 5.0, 10.0)
_BAR_HEIGHT, _BAR_GAP, _NAME_WIDTH, _VALUE_WIDTH = 18.0, 6.0, 120.0, 84.0
_MAX_NAME = 18
_COLOURS = ("#2a78b8", "#d9822b", "#3a9d5d", "#b8475a", "#8463b8", "#8a6a4f", "#5b9aa8", "#7a7a7a")


@dataclass(frozen=True, slots=True)
class Line:
    """One run's values: x and y of equal length; y has gaps where it is not finite."""

    colour: str
    x: Float64[ndarray, " n"]
    y: Float64[ndarray, " n"]


def run_colour(index: int) -> str:
    """Return the colour of a run in all plots; after eight runs the colours repeat."""
    return _COLOURS[index % len(_COLOURS)]


def bar_chart(title: str, values: Mapping[str, tuple[str, float]], text_of: Callable[[float], str]) -> Element:
    """Return a figure with one bar for each run. values: colour and value by run name."""
    top = max(max((value for _, value in values.values()), default=0.0), 1e-12)
    space = _WIDTH - _NAME_WIDTH - _VALUE_WIDTH
    parts: list[Element] = []
    for row, (name, (colour, value)) in enumerate(values.items()):
        y = row * (_BAR_HEIGHT + _BAR_GAP)
        length = max(0.0, value / top * space)
        box = {"x": f"{_NAME_WIDTH:g}", "y": f"{y:g}", "width": f"{length:.1f}", "height": f"{_BAR_HEIGHT:g}"}
        short = name if len(name) <= _MAX_NAME else f"{name[: _MAX_NAME - 1]}…"
        parts += [
            _text(short, _NAME_WIDTH - 8, y + 13, "end"),
            element("rect", element("title", name), attributes={**box, "fill": colour}),
            _text(text_of(value), _NAME_WIDTH + length + 6, y + 13, "start"),
        ]
    height = len(values) * (_BAR_HEIGHT + _BAR_GAP)
    return _chart(title, height, parts)


def line_chart(title: str, lines: Mapping[str, Line], text_of: Callable[[float], str]) -> Element:
    """Return a figure with one line for each run over the frame index."""
    x_low, x_high = _range(np.concatenate([line.x for line in lines.values()]))
    values = np.concatenate([line.y for line in lines.values()])
    y_ticks = _tick_values(0.0, max(float(np.max(values, initial=0.0)), 1e-9))
    y_high = y_ticks[-1]
    parts: list[Element] = []
    for tick in y_ticks:
        y = _HEIGHT - _BOTTOM - tick / y_high * (_HEIGHT - _TOP - _BOTTOM)
        grid = {"class": "gridline", "points": f"{_LEFT},{y:.1f} {_WIDTH - _RIGHT},{y:.1f}"}
        parts += [element("polyline", attributes=grid), _text(text_of(tick), _LEFT - 6, y + 4, "end")]
    for frame in (x_low, x_high):
        x = _LEFT + (frame - x_low) / max(x_high - x_low, 1.0) * (_WIDTH - _LEFT - _RIGHT)
        parts.append(_text(f"{frame:.0f}", x, _HEIGHT - _BOTTOM + 16, "start" if frame == x_low else "end"))
    parts.append(_text("frame", (_LEFT + _WIDTH - _RIGHT) / 2, _HEIGHT - 6, "middle"))
    for name, line in lines.items():
        chosen = np.unique(np.linspace(0, len(line.x) - 1, _MAX_POINTS).astype(int))
        xs = _LEFT + (line.x[chosen] - x_low) / max(x_high - x_low, 1.0) * (_WIDTH - _LEFT - _RIGHT)
        ys = _HEIGHT - _BOTTOM - line.y[chosen] / y_high * (_HEIGHT - _TOP - _BOTTOM)
        points = " ".join(f"{x:.1f},{y:.1f}" for x, y in zip(xs, ys, strict=True))
        attributes = {"class": "line", "points": points, "stroke": line.colour}
        parts.append(element("polyline", element("title", name), attributes=attributes))
    return _chart(title, _HEIGHT, parts)


def run_legend(colours: Mapping[str, str]) -> Element:
    """Return the runs' names with their colours."""
    entries = [
        styled(
            "span", "legend-entry", element("span", attributes={"class": "swatch", "style": f"background:{c}"}), name
        )
        for name, c in colours.items()
    ]
    return styled("div", "legend", *entries)


def _chart(title: str, height: float, parts: list[Element]) -> Element:
    attributes = {"viewBox": f"0 0 {_WIDTH:g} {height:g}", "role": "img", "aria-label": title, "class": "chart"}
    return element("figure", element("figcaption", title), element("svg", *parts, attributes=attributes))


def _text(text: str, x: float, y: float, anchor: str) -> Element:
    return element("text", text, attributes={"x": f"{x:.1f}", "y": f"{y:.1f}", "text-anchor": anchor})


def _range(values: Float64[ndarray, " n"]) -> tuple[float, float]:
    return float(np.min(values)), float(np.max(values))


def _tick_values(low: float, high: float) -> list[float]:
    """Return about four round values that cover the range from low to high."""
    raw = (high - low) / _TICKS
    magnitude = 10.0 ** math.floor(math.log10(raw))
    step = next(each * magnitude for each in _STEPS if each * magnitude >= raw * (1 - 1e-9))
    count = math.ceil((high - low) / step - 1e-9)
    return [low + i * step for i in range(count + 1)]
