"""The distortion of a lens, by the models of OpenCV, and its text form."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.domain.checks import require_number, require_types
from gausslite.domain.errors import InvalidInputError

_MAX_COEFFICIENT = 1e3


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
        require_types(model=(self.model, LensModel), coefficients=(self.coefficients, (tuple, list, ndarray)))
        for value in self.coefficients:
            require_number(f"lens {self.model}", value)
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
