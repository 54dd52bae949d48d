"""The three trajectories through the two-room home."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite_sim.trajectory import TrajectorySampler, look_at_poses, spline_trajectory
from gausslite_sim.two_room_layout import TABLE_CENTRE_M

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
"""Waypoints: past the chairs, through the doorway, around the living room and back."""

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
"""Waypoints above and below the other trajectories, looking at the same objects."""


def _around_the_table(frames: int, numbers: Float64[ndarray, " n"] | None = None) -> Float64[ndarray, "n 4 4"]:
    """Return poses on an ellipse around the table, with the camera towards its centre."""
    a = 2 * np.pi * (np.arange(frames) if numbers is None else numbers) / frames - 0.5 * np.pi
    eyes = np.stack([_CX + 1.5 * np.cos(a), _CY + 1.3 * np.sin(a), 1.42 + 0.12 * np.sin(3 * a)], axis=1)
    targets = np.stack([_CX + 0.25 * np.sin(2 * a), _CY + 0.12 * np.cos(3 * a), 0.72 + 0.08 * np.cos(2 * a)], axis=1)
    return look_at_poses(eyes, targets)


TRAJECTORIES: tuple[TrajectorySampler, ...] = (
    _around_the_table,
    spline_trajectory(_KITCHEN_TO_LIVING),
    spline_trajectory(_HELD_OUT),
)
"""0: agent A around the table. 1: agent B past the chairs to the living room. 2: held-out views."""
