"""Convert a live camera's lens and motion between protobuf messages and domain objects, with bounds."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.domain.camera_motion import CameraMotion
from gausslite.domain.errors import InvalidInputError
from gausslite.domain.lens import Lens, LensModel
from gausslite.domain.trajectory import Twist
from gausslite.v1 import geometry_pb2

_MAX_VELOCITY = 100.0
_LENS_MODELS = {
    geometry_pb2.LENS_MODEL_RADTAN: LensModel.RADTAN,
    geometry_pb2.LENS_MODEL_FISHEYE: LensModel.FISHEYE,
}
_LENS_NUMBERS = {model: number for number, model in _LENS_MODELS.items()}


def lens_to_message(lens: Lens) -> geometry_pb2.Lens:
    """Encode a lens."""
    return geometry_pb2.Lens(model=_LENS_NUMBERS[lens.model], coefficients=lens.coefficients)


def lens_from_message(message: geometry_pb2.EncodedFrame) -> Lens | None:
    """Return the lens of a frame, None for a pinhole. Raises InvalidInputError."""
    if not message.HasField("lens"):
        return None
    if message.lens.model not in _LENS_MODELS:
        raise InvalidInputError(f"frame lens: expected the model RADTAN or FISHEYE, got number {message.lens.model}")
    return Lens(_LENS_MODELS[message.lens.model], tuple(message.lens.coefficients))


def twist_to_message(twist: Twist) -> geometry_pb2.Twist:
    """Encode a velocity."""
    linear, angular = (
        geometry_pb2.Point(x=float(v[0]), y=float(v[1]), z=float(v[2])) for v in (twist.linear_m_s, twist.angular_rad_s)
    )
    return geometry_pb2.Twist(linear_m_s=linear, angular_rad_s=angular)


def motion_from_message(message: geometry_pb2.EncodedFrame) -> CameraMotion | None:
    """Return the motion of a frame, None if it states no twist. Raises InvalidInputError."""
    if not message.HasField("twist"):
        if message.readout_seconds != 0.0 or message.exposure_seconds != 0.0:
            raise InvalidInputError("frame twist: expected one with readout_seconds or exposure_seconds, got none")
        return None
    twist = Twist(
        _velocity("linear_m_s", message.twist.linear_m_s), _velocity("angular_rad_s", message.twist.angular_rad_s)
    )
    return CameraMotion(twist, message.readout_seconds, message.exposure_seconds)


def _velocity(name: str, point: geometry_pb2.Point) -> Float64[ndarray, "3"]:
    velocity = np.array([point.x, point.y, point.z])
    if not (np.abs(velocity) <= _MAX_VELOCITY).all():
        raise InvalidInputError(
            f"frame twist {name}: expected finite values up to {_MAX_VELOCITY:g}, got {velocity.tolist()}"
        )
    return velocity
