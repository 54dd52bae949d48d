"""Place the names of objects so that they do not cover each other where the page's camera starts."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.domain.objects import ObjectLandmark
from gausslite.view.start_view import StartView

_FOV_RAD = np.deg2rad(75.0)
"""Vertical field of view of the page's camera, viser's default."""
_LINE, _LETTER = 0.03, 0.013
"""Height of a label and width of a letter, as shares of the window's height; for a window 700 pixels high."""
_NEAR_M = 0.1


def label_text(landmark: ObjectLandmark) -> str:
    """Return the object's name and confidence."""
    return f"{landmark.noun} {landmark.confidence:.2f}"


def label_positions_m(objects: Sequence[ObjectLandmark], view: StartView) -> Float64[ndarray, "n 3"]:
    """Return where each object's label is: on its box, or higher if another label is there in this view."""
    up = np.array(view.up)
    positions_m = np.array([_top_m(each, up) for each in objects]).reshape(-1, 3)
    screen, depth_m = _project(positions_m, view)
    placed: list[tuple[float, float, float]] = []
    # from the bottom of the window to its top, so that a label that moves up meets only labels above it
    for i in np.argsort(screen[:, 1], kind="stable"):
        if depth_m[i] < _NEAR_M:
            continue
        width, height = _LETTER * len(label_text(objects[i])), _free_height(screen[i], objects[i], placed)
        placed.append((float(screen[i, 0]), height, width))
        positions_m[i] += up * _lift_m(positions_m[i], height - float(screen[i, 1]), view)
    return positions_m


def _top_m(landmark: ObjectLandmark, up: Float64[ndarray, "3"]) -> Float64[ndarray, "3"]:
    low, high = np.array(landmark.extent_m.min_m), np.array(landmark.extent_m.max_m)
    top: Float64[ndarray, "3"] = (low + high) / 2 + up * np.abs(up @ (high - low)) / 2
    return top


def _free_height(
    at: Float64[ndarray, "2"], landmark: ObjectLandmark, placed: Sequence[tuple[float, float, float]]
) -> float:
    """Return the lowest height in the window, not below the label's own, that no placed label (x, y, width) covers."""
    width, height = _LETTER * len(label_text(landmark)), float(at[1])
    beside = [y for x, y, other in placed if abs(x - float(at[0])) < (width + other) / 2]
    for taken in sorted(beside):
        if abs(taken - height) < _LINE:
            height = taken + _LINE
    return height


def _lift_m(position_m: Float64[ndarray, "3"], rise: float, view: StartView) -> float:
    """Return how far a point moves along the world's up axis if its image rises by this share of the window."""
    _, camera_up, forward = _axes(view)
    up, offset_m = np.array(view.up), position_m - np.array(view.position_m)
    target = (offset_m @ camera_up) / (offset_m @ forward) + rise * 2 * np.tan(_FOV_RAD / 2)
    # (offset + s up) @ camera_up = target (offset + s up) @ forward
    slope = up @ camera_up - target * (up @ forward)
    lift_m: float = float((target * (offset_m @ forward) - offset_m @ camera_up) / slope) if slope > 1e-3 else 0.0
    return lift_m


def _project(
    points_m: Float64[ndarray, "n 3"], view: StartView
) -> tuple[Float64[ndarray, "n 2"], Float64[ndarray, " n"]]:
    """Return the places in the window as shares of its height, x to the right and y up, and the depths."""
    right, camera_up, forward = _axes(view)
    offsets_m = points_m - np.array(view.position_m)
    depth_m = offsets_m @ forward
    scale = np.maximum(depth_m, _NEAR_M) * 2 * np.tan(_FOV_RAD / 2)
    return np.stack([offsets_m @ right, offsets_m @ camera_up], axis=1) / scale[:, None], depth_m


def _axes(view: StartView) -> tuple[Float64[ndarray, "3"], Float64[ndarray, "3"], Float64[ndarray, "3"]]:
    """Return the camera's right, up and forward axes."""
    forward = np.subtract(view.look_at_m, view.position_m)
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, np.array(view.up))
    right /= max(float(np.linalg.norm(right)), 1e-9)
    return right, np.cross(right, forward), forward
