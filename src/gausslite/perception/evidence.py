"""Decide whether a landmark has enough evidence: repeated or confident detections, and few misses when in view."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from gausslite.domain.camera import project
from gausslite.domain.errors import InvalidInputError
from gausslite.domain.frame import Frame
from gausslite.domain.pose import inverse, transform_points
from gausslite.perception.object_map import Landmark

_RELIABLE_FACTOR: Final = 3
_WEAK_SHARE: Final = 0.5
# slightly below a third: two misses for each detection are accepted
_MIN_PRESENT_SHARE: Final = 0.33
_NEAR_M: Final = 0.05
_DEPTH_SLACK_M: Final = 0.10
_DEPTH_SLACK_SHARE: Final = 0.02
_MIN_VISIBLE_SHARE: Final = 0.6
_MAX_DISTANCE_FACTOR: Final = 1.1


@dataclass(frozen=True, slots=True)
class EvidenceSettings:
    """A landmark is confirmed after min_seen detections, or one of confident_score or more.

    Of the frames that should show it, at least min_seen_fraction must have detected it. Its scores must sum to
    at least 1 / max_rival_ratio of those of any different thing detected in its place: the nearest class of a detector
    is not always the class of the object. Its best score must be at least min_score_share of the best score among the
    objects of its target: jars are detected as bottles, with lower scores than the bottles. After min_seen_known
    detections, earlier frames get its mask too.
    """

    min_seen: int = 2
    min_seen_known: int = 3
    confident_score: float = 0.6
    min_seen_fraction: float = 0.25
    max_rival_ratio: float = 1.3
    min_score_share: float = 0.45

    def __post_init__(self) -> None:
        for name in ("min_seen", "min_seen_known"):
            if getattr(self, name) < 1:
                raise InvalidInputError(f"evidence {name}: expected at least 1, got {getattr(self, name)}")
        for name in ("confident_score", "min_seen_fraction", "min_score_share"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise InvalidInputError(f"evidence {name}: expected 0 to 1, got {getattr(self, name)}")
        if not self.max_rival_ratio > 0:
            raise InvalidInputError(f"evidence max_rival_ratio: expected a positive number, got {self.max_rival_ratio}")

    @classmethod
    def accept_all(cls) -> EvidenceSettings:
        """Return settings that confirm every detection."""
        return cls(min_seen=1, confident_score=0.0, min_seen_fraction=0.0, max_rival_ratio=np.inf, min_score_share=0.0)

    @classmethod
    def accept_similar(cls) -> EvidenceSettings:
        """Return settings that also confirm objects that are rather a different thing."""
        return cls(max_rival_ratio=np.inf, min_score_share=0.0)

    def is_confirmed(self, landmark: Landmark) -> bool:
        """Return True if the landmark has enough evidence to exist."""
        seen, missed = landmark.seen_count, landmark.missed_count
        has_evidence = seen >= self.min_seen or landmark.best_score >= self.confident_score
        is_found = seen >= self.min_seen_fraction * (seen + missed)
        return has_evidence and is_found and self.rival(landmark) is None

    def rival(self, landmark: Landmark) -> str | None:
        """Return the different thing that the landmark rather is by the sums of the scores; None if there is none."""
        name, score = max(landmark.rival_scores.items(), key=lambda each: each[1], default=("", 0.0))
        return name if score > self.max_rival_ratio * landmark.score_sum else None

    def without_low_scores(self, landmarks: Sequence[Landmark]) -> list[Landmark]:
        """Return those of one target's landmarks whose best scores are not far below the best of all."""
        limit = self.min_score_share * max((each.best_score for each in landmarks), default=0.0)
        return [each for each in landmarks if each.best_score >= limit]

    def is_reliable(self, landmark: Landmark) -> bool:
        """Return True if a confident detection, or three times min_seen detections, confirm the landmark.

        Superlatives ("closest to") use only such landmarks.
        """
        min_seen = _RELIABLE_FACTOR * self.min_seen
        has_evidence = landmark.seen_count >= min_seen or landmark.best_score >= self.confident_score
        return has_evidence and self.is_confirmed(landmark)

    def is_known(self, landmark: Landmark) -> bool:
        """Return True if the landmark is confirmed and detected so often that earlier frames get its mask.

        A weak detection counts half.
        """
        found = landmark.seen_count + _WEAK_SHARE * landmark.weak_count
        return found >= self.min_seen_known and self.is_confirmed(landmark)

    def is_present(self, landmark: Landmark) -> bool:
        """Return True if the latest frame with detections found the landmark, or few frames missed a known one."""
        if landmark.missed_in_a_row == 0:
            return True
        found = landmark.seen_count + landmark.weak_count
        is_often_found = found >= _MIN_PRESENT_SHARE * (found + landmark.missed_count)
        return is_often_found and (self.is_known(landmark) or self.is_reliable(landmark))

    def needs_observation(self, landmark: Landmark) -> bool:
        """Return True if one more observation could confirm the landmark."""
        return not self.is_confirmed(landmark) and landmark.seen_count + 1 >= self.min_seen


@dataclass(frozen=True, slots=True, eq=False)
class VisibilityCheck:
    """Decides whether a frame should show a landmark. depth_m: the depth of the nearest surface in each pixel."""

    frame: Frame
    depth_m: Float32[ndarray, "h w"]

    def is_visible(self, landmark: Landmark) -> bool:
        """Return True if most of the landmark's cells are in view, unoccluded and near enough to be detected.

        The cells of an object that was removed are also visible: the frame then shows the surface behind them.
        """
        camera_m = self.frame.T_world_camera[:3, 3]
        if float(np.linalg.norm(landmark.centroid_m - camera_m)) > _MAX_DISTANCE_FACTOR * landmark.farthest_m:
            return False
        cells = transform_points(inverse(self.frame.T_world_camera), landmark.footprint_m().astype(np.float64))
        z_m = cells[:, 2]
        in_front = np.column_stack([cells[:, :2], np.maximum(z_m, _NEAR_M)]).astype(np.float32)
        pixels = np.floor(project(in_front, self.frame.camera)).astype(np.int64)
        height, width = self.depth_m.shape
        inside = (z_m > _NEAR_M) & (pixels >= 0).all(axis=1) & (pixels < (width, height)).all(axis=1)
        columns, rows = pixels[inside].T
        sensed_m = self.depth_m[rows, columns]
        unoccluded = (sensed_m > 0) & (z_m[inside] <= sensed_m * (1.0 + _DEPTH_SLACK_SHARE) + _DEPTH_SLACK_M)
        return bool(np.count_nonzero(unoccluded) >= _MIN_VISIBLE_SHARE * len(cells))
