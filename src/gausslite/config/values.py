"""Read option values from text."""

from __future__ import annotations

import argparse
import math

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.datasets.poses import pose_from_quaternion
from gausslite.domain.camera_correction import CameraCorrection
from gausslite.domain.depth_registration import DepthRegistration
from gausslite.domain.errors import PoseError
from gausslite.domain.pose import UpAxis
from gausslite.domain.pose_exposure_prior import PoseExposurePrior
from gausslite.mapping.stages import SkippableStage

AUTO, NONE = "auto", "none"


def read_names(text: str) -> tuple[str, ...]:
    """Return the parts of "a,b" without surrounding spaces."""
    return tuple(part.strip() for part in text.split(",") if part.strip())


def read_numbers(text: str, count: int) -> list[float]:
    """Return exactly `count` finite numbers of "1,2". Raises ArgumentTypeError."""
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) != count or not all(math.isfinite(value) for value in values):
        raise argparse.ArgumentTypeError(f"expected {count} finite numbers separated by commas, got {text!r}")
    return values


def read_up_axis(text: str) -> UpAxis:
    """Return the axis of "x,y,z". Raises ArgumentTypeError."""
    x, y, z = read_numbers(text, 3)
    return (x, y, z)


def read_rigid_transform(text: str) -> Float64[ndarray, "4 4"]:
    """Return the transform of "x,y,z" in metres, or with a quaternion "x,y,z,qx,qy,qz,qw". Raises ArgumentTypeError."""
    values = np.array(read_numbers(text, 3 if text.count(",") < 3 else 7))
    try:
        return pose_from_quaternion("", values[:3], values[3:] if len(values) == 7 else np.array([0.0, 0.0, 0.0, 1.0]))
    except PoseError:
        raise argparse.ArgumentTypeError(f"expected a quaternion of length 1 as qx,qy,qz,qw, got {text!r}") from None


def read_skip_stages(text: str) -> tuple[SkippableStage, ...]:
    """Return the stages of "publishing,seeding", each once. Raises ArgumentTypeError."""
    try:
        return tuple(dict.fromkeys(SkippableStage(name) for name in read_names(text)))
    except ValueError:
        known = ", ".join(SkippableStage)
        raise argparse.ArgumentTypeError(f"expected names among {known}, got {text!r}") from None


def read_depth_registration(text: str) -> DepthRegistration | str:
    """Return AUTO, NONE or a camera. Raises InvalidInputError."""
    return text if text in (AUTO, NONE) else DepthRegistration.parse(text)


def read_camera_correction(text: str) -> CameraCorrection:
    """Return the correction of NONE (images as recorded) or of its text form. Raises InvalidInputError."""
    return CameraCorrection() if text == NONE else CameraCorrection.parse(text)


def read_camera_correction_or_auto(text: str) -> CameraCorrection | str:
    """Return AUTO, or the correction that `read_camera_correction` returns. Raises InvalidInputError."""
    return text if text == AUTO else read_camera_correction(text)


def read_pose_prior(text: str) -> PoseExposurePrior:
    """Return the prior of NONE (exact poses) or of numbers. Raises InvalidInputError."""
    return PoseExposurePrior() if text == NONE else PoseExposurePrior.parse(text)


def read_pose_prior_or_auto(text: str) -> PoseExposurePrior | str:
    """Return AUTO, or the prior that `read_pose_prior` returns. Raises InvalidInputError."""
    return text if text == AUTO else read_pose_prior(text)
