"""Correct a frame of a live camera by the motion and lens that come with it; its other poses are not known."""

from __future__ import annotations

import numpy as np

from gausslite.datasets.camera_correction import ideal_camera, undistort_frame
from gausslite.domain.camera_correction import CameraCorrection
from gausslite.domain.camera_motion import CameraMotion
from gausslite.domain.frame import Frame
from gausslite.domain.lens import Lens
from gausslite.domain.trajectory import Twist


def correct_live_frame(frame: Frame, lens: Lens | None) -> Frame:
    """Return the frame without lens distortion; its motion states rolling shutter and blur of the returned image.

    lens: that of the recorded image, None for a pinhole. Raises InvalidInputError for a lens without a usable pinhole
    camera.
    """
    motion = frame.motion or CameraMotion(Twist(np.zeros(3), np.zeros(3)))
    correction = CameraCorrection(lens, motion.readout_s, exposure_s=motion.exposure_s)
    if correction.is_identity:
        return frame
    ideal = ideal_camera(frame.camera, CameraCorrection(lens), 0.0)
    return undistort_frame(frame, correction, ideal, motion.twist)
