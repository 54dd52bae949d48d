"""Refine the motion between two frames by all their pixels: point features and renderings err by centimetres."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.domain.frame import Frame
from gausslite.domain.pose import orthonormal
from gausslite_poses.photometric import align_images

_GUESS_STD = np.array([0.03] * 3 + [np.radians(0.7)] * 3)
"""Error of the motion that is refined: metres and radians."""
_MIN_OVERLAP = 0.5
"""Share of the points in both images whose depth must agree."""


def refined_by_images(
    reference: Frame, frame: Frame, T_reference_camera: Float64[ndarray, "4 4"]
) -> Float64[ndarray, "4 4"]:
    """Return the motion that aligns all pixels of two images; the given one if they share too little."""
    aligned = align_images(reference, frame, T_reference_camera, _GUESS_STD)
    if aligned is None or aligned.overlap < _MIN_OVERLAP:
        return T_reference_camera
    return orthonormal(aligned.T_world_camera)
