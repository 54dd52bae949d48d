"""When a remembered object is believed: seen again from another place, or once for sure, and not mostly overlooked."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from gausslite.domain.camera import project
from gausslite.domain.frame import Frame
from gausslite.domain.pose import inverse, transform_points
from gausslite.errors import InvalidInputError
from gausslite.perception.object_map import Landmark

_RELIABLE_FACTOR: Final = 3
_NEAR_M: Final = 0.05
_BEHIND_M: Final = 0.10
_BEHIND_SHARE: Final = 0.02
_MIN_SHOWN: Final = 0.6
_FARTHER: Final = 1.1


@dataclass(frozen=True, slots=True)
class EvidenceSettings:
    """Believed is what was seen min_seen times, or once with confident_score, in min_seen_fraction of the views that show its place.

    The least of each (1, 0 and 0) believes every detection.
    """

    min_seen: int = 2
    confident_score: float = 0.6
    min_seen_fraction: float = 0.25

    def __post_init__(self) -> None:
        if self.min_seen < 1:
            raise InvalidInputError(f"evidence min_seen: expected at least 1, got {self.min_seen}")
        for name in ("confident_score", "min_seen_fraction"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise InvalidInputError(f"evidence {name}: expected 0 to 1, got {getattr(self, name)}")

    @classmethod
    def accept_all(cls) -> EvidenceSettings:
        """Every detection counts."""
        return cls(min_seen=1, confident_score=0.0, min_seen_fraction=0.0)

    def is_confirmed(self, each: Landmark) -> bool:
        """True when there is enough to go by."""
        often = each.seen_count >= self.min_seen or each.best_score >= self.confident_score
        return often and each.seen_count >= self.min_seen_fraction * (each.seen_count + each.missed_count)

    def is_reliable(self, each: Landmark) -> bool:
        """True when it is believed and could not be two mistakes: one false candidate would decide a superlative."""
        often = each.seen_count >= _RELIABLE_FACTOR * self.min_seen or each.best_score >= self.confident_score
        return often and self.is_confirmed(each)

    def needs_observation(self, each: Landmark) -> bool:
        """True when one more observation could settle it."""
        return not self.is_confirmed(each) and each.seen_count + 1 >= self.min_seen


@dataclass(frozen=True, slots=True, eq=False)
class VisibilityCheck:
    """What a frame could show: depth_m is that of its nearest surfaces."""

    frame: Frame
    depth_m: Float32[ndarray, "h w"]

    def is_visible(self, each: Landmark) -> bool:
        """True when most of the object's cells lie in view with nothing before them, no farther than it was seen from.

        An object that is gone still has its place: then what lies behind is seen.
        """
        eye_m = self.frame.T_world_camera[:3, 3]
        if float(np.linalg.norm(each.centroid_m - eye_m)) > _FARTHER * each.farthest_m:
            return False
        cells = transform_points(inverse(self.frame.T_world_camera), each.footprint_m().astype(np.float64))
        z_m = cells[:, 2]
        in_front = np.column_stack([cells[:, :2], np.maximum(z_m, _NEAR_M)]).astype(np.float32)
        pixels = np.floor(project(in_front, self.frame.camera)).astype(np.int64)
        height, width = self.depth_m.shape
        inside = (z_m > _NEAR_M) & (pixels >= 0).all(axis=1) & (pixels < (width, height)).all(axis=1)
        columns, rows = pixels[inside].T
        sensed_m = self.depth_m[rows, columns]
        open_to_view = (sensed_m > 0) & (z_m[inside] <= sensed_m * (1.0 + _BEHIND_SHARE) + _BEHIND_M)
        return bool(np.count_nonzero(open_to_view) >= _MIN_SHOWN * len(cells))
