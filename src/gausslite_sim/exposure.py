"""A camera whose exposure and white balance follow what it sees: slow, smooth changes along a walk."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32
from numpy import ndarray


def camera_gain(share: float, drift: float, trajectory: int) -> Float32[ndarray, "3"]:
    """Factors of red, green and blue at this share of the walk, 1 - drift to 1 + drift."""
    turn = 2 * np.pi * share + 1.7 * trajectory
    brightness = 0.6 * np.sin(1.3 * turn) + 0.25 * np.sin(3.1 * turn + 0.8)
    warmth = 0.15 * np.sin(1.9 * turn + 2.1)
    return np.asarray(1.0 + drift * np.array([brightness + warmth, brightness, brightness - warmth]), np.float32)
