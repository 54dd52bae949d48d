"""A set of Gaussians as columns of physical values; raw log-scales and logits live only in `optimize`."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Int16, UInt32
from numpy import ndarray
from numpy.typing import NDArray

from gausslite.domain.arrays import require_array


@dataclass(frozen=True, slots=True, eq=False)
class Gaussians:
    """n Gaussians (Sec. III-A): geometry and colour, plus active flag, kappa and target index.

    kappa counts the active-phase iterations that trained a Gaussian; target indexes TaskGraph.targets (-1 none).
    """

    means_m: Float32[ndarray, "n 3"]
    quats_wxyz: Float32[ndarray, "n 4"]
    scales_m: Float32[ndarray, "n 3"]
    opacities: Float32[ndarray, " n"]
    rgb: Float32[ndarray, "n 3"]
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

    def take(self, rows: NDArray[Any]) -> Gaussians:
        """Return the Gaussians at these indices, or where this boolean mask is True."""
        indices = np.flatnonzero(rows) if rows.dtype == np.bool_ else rows
        return Gaussians(*(np.take(getattr(self, field.name), indices, axis=0) for field in fields(self)))

    @classmethod
    def concatenate(cls, parts: list[Gaussians]) -> Gaussians:
        """Return the Gaussians of all parts, in order."""
        if not parts:
            return cls.empty()
        return cls(*(np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(cls)))
