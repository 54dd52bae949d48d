"""The poses of a simulated odometry: each motion has an error in proportion to its length and its angle."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.domain.pose import inverse, orthonormal, transform_of, twist_of

_TURNS = 2.0
"""Number of sine periods of each component of the error direction during a trajectory."""


def drifting_poses(
    poses: Float64[ndarray, "n 4 4"], drift: float, rng: np.random.Generator
) -> Float64[ndarray, "n 4 4"]:
    """Return T_world_camera by an odometry that starts at the first pose.

    Each motion errs by `drift` times the distance moved and `drift` times the angle turned, in directions that change
    slowly and smoothly, so that errors add up to a drift.
    """
    phases = rng.uniform(0.0, 2 * np.pi, (2, 3))
    out = [poses[0]]
    for i in range(1, len(poses)):
        step = inverse(poses[i - 1]) @ poses[i]
        motion = twist_of(step)
        waves = np.sin(2 * np.pi * _TURNS * i / len(poses) + phases)
        directions = waves / np.maximum(np.linalg.norm(waves, axis=1, keepdims=True), 1e-9)
        lengths = np.linalg.norm(motion.reshape(2, 3), axis=1, keepdims=True)
        out.append(orthonormal(out[-1] @ step @ transform_of((drift * lengths * directions).ravel())))
    return np.stack(out)
