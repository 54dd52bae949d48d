"""Read the values of options that have a text form of their own, and write them."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Mapping, Sequence
from operator import attrgetter
from pathlib import Path
from typing import Any, TypeVar

from gausslite.domain.errors import InvalidInputError
from gausslite.domain.pose import UpAxis
from gausslite.domain.recording import CameraCorrection, DepthRegistration, PoseExposurePrior
from gausslite.domain.relevance import TargetPoint
from gausslite.domain.voxels import MAX_VOXEL_M, MIN_VOXEL_M, VoxelGrid

AUTO, NONE = "auto", "none"
Value = TypeVar("Value")
CAMERA_FORM = "FX,FY,CX,CY[,TX,TY,TZ[,RX,RY,RZ]]"
CORRECTION_FORM = "lens=MODEL:K1,...;readout=S;offset=S"
PRIOR_FORM = "M,DEG[,GAIN,OFFSET]"
VOXEL_SIZE: Mapping[str, Any] = {
    "key": "voxel-size",
    "unit": "m",
    "low": MIN_VOXEL_M,
    "high": MAX_VOXEL_M,
    "plain_type": float,
    "convert": VoxelGrid,
    "to_plain": attrgetter("size_m"),
}
"""The declaration of an option whose field is a grid."""


def not_empty(text: str) -> str:
    """Return the text. Raises InvalidInputError if it is empty."""
    if not text:
        raise InvalidInputError("expected a text, got an empty one")
    return text


def read_path(text: str) -> Path:
    """Return the path. Raises InvalidInputError for an empty text, which would stand for the current folder."""
    if not text:
        raise InvalidInputError("path: expected the name of a file or folder, got an empty text")
    return Path(text)


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


def write_numbers(values: Sequence[float]) -> str:
    """Return the text that `read_numbers` reads."""
    return ",".join(f"{value:.17g}" for value in values)


def read_target_points(texts: Sequence[str]) -> tuple[TargetPoint, ...]:
    """Return the points of "x,y,z" or "x,y,z,r", in metres. Raises ArgumentTypeError, InvalidInputError."""
    values = (read_numbers(text, 3 if text.count(",") < 3 else 4) for text in texts)
    return tuple(TargetPoint((x, y, z), *radius_m) for x, y, z, *radius_m in values)


def write_target_points(points: Sequence[TargetPoint]) -> list[str]:
    """Return the texts that `read_target_points` reads."""
    return [write_numbers(p.point_m if p.radius_m is None else (*p.point_m, p.radius_m)) for p in points]


def read_registration(text: str) -> DepthRegistration | None:
    """Return the camera to register depth to, None for NONE. Raises InvalidInputError."""
    return None if text == NONE else DepthRegistration.parse(text)


def read_registration_or_auto(text: str) -> DepthRegistration | str:
    """Return AUTO, NONE or a camera. Raises InvalidInputError."""
    return text if text in (AUTO, NONE) else DepthRegistration.parse(text)


def read_correction(text: str) -> CameraCorrection:
    """Return the correction of NONE (images as recorded) or of its text form. Raises InvalidInputError."""
    return CameraCorrection() if text == NONE else CameraCorrection.parse(text)


def write_correction(correction: CameraCorrection | str) -> str:
    """Return the text that `read_correction` reads; AUTO stays."""
    return NONE if isinstance(correction, CameraCorrection) and correction.is_identity else str(correction)


def read_prior(text: str) -> PoseExposurePrior:
    """Return the prior of NONE (exact poses) or of numbers. Raises InvalidInputError."""
    return PoseExposurePrior() if text == NONE else PoseExposurePrior.parse(text)


def write_prior(prior: PoseExposurePrior | str) -> str:
    """Return the text that `read_prior` reads; AUTO stays."""
    return NONE if isinstance(prior, PoseExposurePrior) and prior.is_exact else str(prior)


def or_auto(read: Callable[[str], Value]) -> Callable[[str], Value | str]:
    """Return what reads AUTO, which stays, or a text that `read` reads."""
    return lambda text: text if text == AUTO else read(text)
