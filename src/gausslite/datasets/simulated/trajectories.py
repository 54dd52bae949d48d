"""The three walks through the home: smooth curves through places and what is looked at from there."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.datasets.simulated.layout import TABLE_CENTRE_M

_CX, _CY = TABLE_CENTRE_M

_KITCHEN_TO_LIVING = (
    ((2.75, 0.60, 1.55), (2.0, 2.1, 0.60)),
    ((3.55, 0.75, 1.50), (2.1, 2.1, 0.55)),
    ((3.75, 1.60, 1.45), (2.2, 2.3, 0.55)),
    ((3.60, 2.60, 1.40), (2.2, 2.1, 0.60)),
    ((3.70, 2.55, 1.45), (3.0, 0.5, 0.80)),
    ((3.95, 2.35, 1.45), (5.6, 0.9, 0.60)),
    ((4.60, 2.20, 1.50), (6.8, 2.0, 0.70)),
    ((5.30, 2.00, 1.55), (6.8, 0.5, 0.70)),
    ((5.80, 2.40, 1.50), (7.9, 2.2, 0.90)),
    ((6.00, 2.30, 1.45), (6.5, 4.3, 0.70)),
    ((6.30, 2.60, 1.45), (5.0, 3.7, 0.50)),
    ((5.70, 2.70, 1.50), (3.0, 2.2, 0.60)),
    ((4.60, 2.30, 1.45), (2.3, 2.1, 0.60)),
    ((3.95, 1.80, 1.50), (2.1, 2.2, 0.60)),
)
"""(eye, looked at) in metres: past the chairs, through the doorway, round the living room and back."""

_HELD_OUT = (
    ((2.95, 1.35, 1.85), (2.0, 2.2, 0.75)),
    ((2.00, 1.25, 1.95), (2.0, 2.3, 0.70)),
    ((1.15, 1.75, 1.80), (2.1, 2.2, 0.75)),
    ((1.35, 2.85, 1.75), (2.2, 2.0, 0.75)),
    ((2.60, 2.90, 1.85), (2.2, 1.8, 0.70)),
    ((3.00, 2.75, 1.85), (2.3, 1.2, 0.45)),
    ((3.30, 2.15, 1.80), (5.0, 1.4, 0.70)),
    ((5.10, 1.75, 1.20), (6.5, 0.6, 0.55)),
    ((6.90, 2.60, 1.25), (6.2, 4.3, 0.75)),
    ((5.90, 3.30, 1.20), (4.9, 3.7, 0.50)),
)
"""Above and below both walks, at the same things."""


TRAJECTORY_COUNT = 3
"""0: agent A round the table. 1: agent B past the chairs to the living room. 2: held-out views off both paths."""


def poses(trajectory: int, frames: int) -> Float64[ndarray, "n 4 4"]:
    """T_world_camera of each frame, evenly spread over the walk (z up; OpenCV camera axes, no roll)."""
    if trajectory == 0:
        eyes, targets = _round_the_table(np.arange(frames) / frames)
    else:
        keys = np.array(_KITCHEN_TO_LIVING if trajectory == 1 else _HELD_OUT)
        share = np.linspace(0.0, 1.0, frames) if frames > 1 else np.array([0.5])
        eyes, targets = _curve(keys[:, 0], share), _curve(keys[:, 1], share)
    return np.stack([_look_at(eye, target) for eye, target in zip(eyes, targets, strict=True)])


def _round_the_table(share: Float64[ndarray, " n"]) -> tuple[Float64[ndarray, "n 3"], Float64[ndarray, "n 3"]]:
    a = 2 * np.pi * share - 0.5 * np.pi
    eyes = np.stack([_CX + 1.5 * np.cos(a), _CY + 1.3 * np.sin(a), 1.42 + 0.12 * np.sin(3 * a)], axis=1)
    targets = np.stack([_CX + 0.25 * np.sin(2 * a), _CY + 0.12 * np.cos(3 * a), 0.72 + 0.08 * np.cos(2 * a)], axis=1)
    return eyes, targets


def _curve(keys: Float64[ndarray, "k 3"], share: Float64[ndarray, " n"]) -> Float64[ndarray, "n 3"]:
    """The Catmull-Rom spline through the keys at these shares of its way."""
    padded = np.concatenate([2 * keys[:1] - keys[1:2], keys, 2 * keys[-1:] - keys[-2:-1]])
    place = share * (len(keys) - 1)
    i = np.minimum(place.astype(np.int64), len(keys) - 2)
    t = (place - i)[:, None]
    p0, p1, p2, p3 = (padded[i + k] for k in range(4))
    bent = 2 * p1 + (p2 - p0) * t + (2 * p0 - 5 * p1 + 4 * p2 - p3) * t**2 + (3 * p1 - p0 - 3 * p2 + p3) * t**3
    return np.asarray(0.5 * bent)


def _look_at(eye_m: Float64[ndarray, "3"], target_m: Float64[ndarray, "3"]) -> Float64[ndarray, "4 4"]:
    forward = (target_m - eye_m) / np.linalg.norm(target_m - eye_m)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    T[:3, 3] = eye_m
    return T
