"""Simulated auto exposure and white balance: slow, smooth changes along a trajectory."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32
from numpy import ndarray


def camera_gain(share: float, amplitude: float, trajectory: int) -> Float32[ndarray, "3"]:
    """Return gains of red, green and blue in [1 - amplitude, 1 + amplitude] at this share of the trajectory."""
    phase = 2 * np.pi * share + 1.7 * trajectory
    brightness = 0.6 * np.sin(1.3 * phase) + 0.25 * np.sin(3.1 * phase + 0.8)
    warmth = 0.15 * np.sin(1.9 * phase + 2.1)
    return np.asarray(1.0 + amplitude * np.array([brightness + warmth, brightness, brightness - warmth]), np.float32)
