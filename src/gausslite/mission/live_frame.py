"""Correct a frame of a live camera by the motion and lens that come with it; its other poses are not known."""

from __future__ import annotations

import numpy as np

from gausslite.datasets.camera_correction import correct_frame, ideal_camera
from gausslite.domain.camera_correction import CameraCorrection
from gausslite.domain.camera_motion import CameraMotion
from gausslite.domain.frame import Frame
from gausslite.domain.lens import Lens
from gausslite.domain.trajectory import Twist


def correct_live_frame(frame: Frame, lens: Lens | None) -> Frame:
    """Return the frame without lens distortion and rolling shutter.

    lens: that of the recorded image, None for a pinhole. Raises InvalidInputError for a lens without a usable pinhole
    camera.
    """
    motion = frame.motion or CameraMotion(Twist(np.zeros(3), np.zeros(3)))
    correction = CameraCorrection(lens, motion.readout_s, exposure_s=motion.exposure_s)
    if correction.is_identity:
        return frame
    speed_rad_s = float(np.linalg.norm(motion.twist.angular_rad_s))
    return correct_frame(frame, correction, ideal_camera(frame.camera, correction, speed_rad_s), motion.twist)
