"""Lens distortion: OpenCV's radial-tangential model and the equidistant fisheye model."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.domain.errors import InvalidInputError

_MAX_COEFFICIENT = 1e3
_NEWTON_STEPS = 20
_NEWTON_DIFFERENCE = 1e-6
_UNDISTORT_TOLERANCE = 1e-7
"""Largest error of an undistorted slope, distorted again: far below a pixel."""


class LensModel(StrEnum):
    """Distortion models, named as ROS camera calibrations name them."""

    RADTAN = "radtan"
    FISHEYE = "fisheye"


_COUNTS = {LensModel.RADTAN: (4, 5, 8), LensModel.FISHEYE: (4,)}


@dataclass(frozen=True, slots=True)
class Lens:
    """Distortion coefficients in OpenCV's order, without unit.

    radtan: k1 k2 p1 p2, then k3, then k4 k5 k6 (4, 5 or 8 numbers). fisheye: k1 k2 k3 k4 of the equidistant model.
    Raises InvalidInputError for another count and for values that are not finite.
    """

    model: LensModel
    coefficients: tuple[float, ...]

    def __post_init__(self) -> None:
        counts = _COUNTS[self.model]
        if len(self.coefficients) not in counts:
            expected = " or ".join(map(str, counts))
            raise InvalidInputError(f"lens {self.model}: expected {expected} numbers, got {len(self.coefficients)}")
        if not all(math.isfinite(value) and abs(value) <= _MAX_COEFFICIENT for value in self.coefficients):
            raise InvalidInputError(
                f"lens {self.model}: expected finite coefficients up to {_MAX_COEFFICIENT:g}, got {self.coefficients}"
            )

    @classmethod
    def parse(cls, text: str) -> Lens:
        """Return the lens written as "MODEL:K1,K2,...". Raises InvalidInputError."""
        model, _, numbers = text.partition(":")
        try:
            return cls(LensModel(model), tuple(float(number) for number in numbers.split(",")))
        except ValueError:
            models = " or ".join(LensModel)
            raise InvalidInputError(f"lens: expected {models} as in radtan:0.1,-0.2,0,0,0, got {text[:60]!r}") from None

    def __str__(self) -> str:
        """Return the text that `parse` reads."""
        return f"{self.model}:" + ",".join(f"{value:.10g}" for value in self.coefficients)

    @property
    def is_identity(self) -> bool:
        """True if the image is that of a pinhole camera."""
        return self.model is LensModel.RADTAN and not any(self.coefficients)

    def distort(
        self, x: Float64[ndarray, "*s"], y: Float64[ndarray, "*s"]
    ) -> tuple[Float64[ndarray, "*s"], Float64[ndarray, "*s"]]:
        """Return where a ray of slopes (x, y) meets the image plane at unit focal length."""
        r2 = x * x + y * y
        if self.model is LensModel.FISHEYE:
            r = np.sqrt(r2)
            theta = np.arctan(r)
            t2 = theta * theta
            k1, k2, k3, k4 = self.coefficients
            distorted = theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
            scale = np.where(r > 0, distorted / np.maximum(r, 1e-12), 1.0)
            return x * scale, y * scale
        k1, k2, p1, p2, k3, k4, k5, k6 = (*self.coefficients, *(0.0,) * (8 - len(self.coefficients)))
        radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
        return (
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        )

    def undistort(
        self, x: Float64[ndarray, " n"], y: Float64[ndarray, " n"]
    ) -> tuple[Float64[ndarray, " n"], Float64[ndarray, " n"]]:
        """Return the slopes of the rays that meet the image plane at (x, y): the inverse of `distort`.

        Raises InvalidInputError for a point that no ray meets, beyond the range in which the model can be inverted.
        """
        u, v, h = x, y, _NEWTON_DIFFERENCE
        with np.errstate(all="ignore"):
            for _ in range(_NEWTON_STEPS):
                error_x, error_y = (at - to for at, to in zip(self.distort(u, v), (x, y), strict=True))
                if max(np.abs(error_x).max(initial=0.0), np.abs(error_y).max(initial=0.0)) <= _UNDISTORT_TOLERANCE:
                    return u, v
                right, left, below, above = (
                    self.distort(u + du, v + dv) for du, dv in ((h, 0), (-h, 0), (0, h), (0, -h))
                )
                xu, yu, xv, yv = right[0] - left[0], right[1] - left[1], below[0] - above[0], below[1] - above[1]
                scale = 2 * h / (xu * yv - xv * yu)
                u, v = u - scale * (yv * error_x - xv * error_y), v - scale * (xu * error_y - yu * error_x)
        worst = int(np.argmax(np.nan_to_num(np.hypot(error_x, error_y), nan=np.inf)))
        raise InvalidInputError(
            f"lens {self}: expected a model that can be inverted over the image, "
            f"got none at the slope ({x[worst]:.2f}, {y[worst]:.2f})"
        )
