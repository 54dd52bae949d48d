"""Colour Gaussians by what they record: their RGB, kappa, the agent that sent them, or the object that they show."""

from __future__ import annotations

import colorsys
from collections.abc import Sequence
from enum import StrEnum

import cv2
import numpy as np
from jaxtyping import Int, UInt8, UInt32
from numpy import ndarray

from gausslite.view.contents import NO_AGENT, ViewContents

UNASSIGNED_RGB = (110, 110, 118)
"""Colour of Gaussians without agent or object."""
_GOLDEN_RATIO = 0.618034
_FIRST_HUE = 0.08


class ColourMode(StrEnum):
    """What the colour of a Gaussian means."""

    RGB = "RGB"
    KAPPA = "kappa"
    AGENT = "agent"
    OBJECT = "object"


def colours_of(contents: ViewContents, mode: ColourMode) -> UInt8[ndarray, "n 3"]:
    """Return the colour of each Gaussian."""
    gaussians = contents.gaussians
    match mode:
        case ColourMode.RGB:
            rgb: UInt8[ndarray, "n 3"] = (np.clip(gaussians.rgb, 0, 1) * 255 + 0.5).astype(np.uint8)
            return rgb
        case ColourMode.KAPPA:
            return _kappa_colours(gaussians.kappa)
        case ColourMode.AGENT:
            return _category_colours(contents.agent)
        case ColourMode.OBJECT:
            return _category_colours(gaussians.target)


def legend_of(contents: ViewContents, mode: ColourMode) -> list[tuple[str, tuple[int, int, int]]]:
    """Return the names and colours that explain a mode; empty for RGB."""
    match mode:
        case ColourMode.RGB:
            return []
        case ColourMode.KAPPA:
            highest = int(contents.gaussians.kappa.max(initial=0))
            # the colours are logarithmic in kappa, so are the values of the legend
            values = np.unique(np.expm1(np.linspace(0, np.log1p(highest), 5)).round().astype(np.uint32))
            return [(f"kappa {v}", _as_rgb(c)) for v, c in zip(values, _kappa_colours(values, highest), strict=True)]
        case ColourMode.AGENT:
            return _category_legend(contents.agents, contents.agent)
        case ColourMode.OBJECT:
            return _category_legend(contents.targets, contents.gaussians.target)


def category_colour(index: int) -> tuple[int, int, int]:
    """Return the colour of an agent or object; neighbouring indices have clearly different hues."""
    red, green, blue = colorsys.hsv_to_rgb((_FIRST_HUE + index * _GOLDEN_RATIO) % 1.0, 0.75, 0.95)
    return round(255 * red), round(255 * green), round(255 * blue)


def _kappa_colours(kappa: UInt32[ndarray, " n"], highest: int | None = None) -> UInt8[ndarray, "n 3"]:
    top = np.log1p(float(kappa.max(initial=0) if highest is None else highest))
    levels = np.log1p(kappa.astype(np.float64)) / max(top, 1e-9)
    image = (255 * levels + 0.5).astype(np.uint8).reshape(-1, 1)
    if not len(image):
        return np.zeros((0, 3), np.uint8)
    colours: UInt8[ndarray, "n 3"] = cv2.applyColorMap(image, cv2.COLORMAP_VIRIDIS)[:, 0, ::-1].copy()
    return colours


def _category_colours(indices: Int[ndarray, " n"]) -> UInt8[ndarray, "n 3"]:
    count = int(indices.max(initial=NO_AGENT)) + 1
    palette = np.array([*(category_colour(index) for index in range(count)), UNASSIGNED_RGB], np.uint8)
    # index -1 is the palette's last entry
    colours: UInt8[ndarray, "n 3"] = palette[np.maximum(indices, -1)]
    return colours


def _category_legend(names: Sequence[str], indices: Int[ndarray, " n"]) -> list[tuple[str, tuple[int, int, int]]]:
    present = [int(index) for index in np.unique(indices) if index >= 0]
    entries = [(names[i] if i < len(names) else f"number {i}", category_colour(i)) for i in present]
    return entries if len(indices) and indices.min() >= 0 else [*entries, ("none", UNASSIGNED_RGB)]


def _as_rgb(colour: UInt8[ndarray, "3"]) -> tuple[int, int, int]:
    return int(colour[0]), int(colour[1]), int(colour[2])
