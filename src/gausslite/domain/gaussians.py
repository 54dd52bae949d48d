"""A set of Gaussians as columns of physical values, with choices of the most important ones and rigid motions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int16, UInt32
from numpy import ndarray
from numpy.typing import NDArray

from gausslite.domain.arrays import require_array
from gausslite.domain.checks import describe
from gausslite.domain.errors import InvalidInputError
from gausslite.domain.pose import transform_points


@dataclass(frozen=True, slots=True, eq=False)
class Gaussians:
    """n Gaussians (Sec. III-A): geometry and colour, plus active flag, kappa and target index.

    kappa counts the active phase's steps that trained a Gaussian; target indexes TaskGraph.targets (-1 none).
    """

    means_m: Float32[ndarray, "n 3"]  # μ, in the world
    quats_wxyz: Float32[ndarray, "n 4"]  # unit quaternions of R
    scales_m: Float32[ndarray, "n 3"]  # standard deviations along the axes, the diagonal of S
    opacities: Float32[ndarray, " n"]  # o, from 0 to 1
    rgb: Float32[ndarray, "n 3"]  # c, in [0, 1] but for rounding
    active: Bool[ndarray, " n"]
    kappa: UInt32[ndarray, " n"]
    target: Int16[ndarray, " n"]

    def __post_init__(self) -> None:
        n = len(self.means_m)
        require_array("means_m", self.means_m, (n, 3), np.float32)
        require_array("quats_wxyz", self.quats_wxyz, (n, 4), np.float32)
        require_array("scales_m", self.scales_m, (n, 3), np.float32)
        require_array("opacities", self.opacities, (n,), np.float32)
        require_array("rgb", self.rgb, (n, 3), np.float32)
        require_array("active", self.active, (n,), np.bool_)
        require_array("kappa", self.kappa, (n,), np.uint32)
        require_array("target", self.target, (n,), np.int16)

    def __len__(self) -> int:
        return len(self.means_m)

    @classmethod
    def empty(cls) -> Gaussians:
        """Return a set without Gaussians."""
        return cls(
            means_m=np.zeros((0, 3), np.float32),
            quats_wxyz=np.zeros((0, 4), np.float32),
            scales_m=np.zeros((0, 3), np.float32),
            opacities=np.zeros(0, np.float32),
            rgb=np.zeros((0, 3), np.float32),
            active=np.zeros(0, np.bool_),
            kappa=np.zeros(0, np.uint32),
            target=np.zeros(0, np.int16),
        )

    def take(self, rows: NDArray[Any] | Sequence[int] | Sequence[bool]) -> Gaussians:
        """Return the Gaussians at these indices, or where this boolean mask is True. Raises InvalidInputError."""
        chosen = np.asarray(rows)
        try:
            if chosen.dtype == np.bool_:
                chosen = np.arange(len(self))[chosen]
            # an empty list has the type of floats
            indices = chosen.astype(np.int64, casting="same_kind" if chosen.size else "unsafe", copy=False)
            return Gaussians(*(np.take(getattr(self, field.name), indices, axis=0) for field in fields(self)))
        except (IndexError, TypeError):
            expected = f"indices below {len(self)} or {len(self)} booleans"
            raise InvalidInputError(f"rows: expected {expected}, got {describe(rows)}") from None

    @classmethod
    def concatenate(cls, parts: list[Gaussians]) -> Gaussians:
        """Return the Gaussians of all parts, in order."""
        if not parts:
            return cls.empty()
        return cls(*(np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(cls)))


def move_gaussians(gaussians: Gaussians, T: Float64[ndarray, "4 4"]) -> Gaussians:
    """Return the Gaussians moved by a rigid motion."""
    if np.array_equal(T, np.eye(4)) or len(gaussians) == 0:
        return gaussians
    means = transform_points(T, gaussians.means_m.astype(np.float64)).astype(np.float32)
    quats = (gaussians.quats_wxyz.astype(np.float64) @ left_product(T[:3, :3]).T).astype(np.float32)
    return replace(gaussians, means_m=means, quats_wxyz=quats)


def left_product(R: Float64[ndarray, "3 3"]) -> Float64[ndarray, "4 4"]:
    """Return the matrix that multiplies quaternions (w, x, y, z) by a rotation from the left."""
    w, x, y, z = _quaternion(R)
    return np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])


def _quaternion(R: Float64[ndarray, "3 3"]) -> Float64[ndarray, "4"]:
    """Return the unit quaternion (w, x, y, z) of a rotation: the main eigenvector of Bar-Itzhack's matrix."""
    (a, b, c), (d, e, f), (g, h, i) = R
    K = np.array(
        [
            [a + e + i, h - f, c - g, d - b],
            [h - f, a - e - i, b + d, c + g],
            [c - g, b + d, e - a - i, f + h],
            [d - b, c + g, f + h, i - a - e],
        ]
    )
    _, vectors = np.linalg.eigh(K)
    return vectors[:, -1]
