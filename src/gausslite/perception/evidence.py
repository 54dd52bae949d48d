"""Decide whether a landmark exists: by its detections, by the frames that missed it, and by what else is detected."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from gausslite.domain.camera import project
from gausslite.domain.frame import Frame
from gausslite.domain.pose import inverse, transform_points
from gausslite.nouns import same_kind
from gausslite.perception.object_map import Landmark
from gausslite.perception.settings import EvidenceSettings

_MIN_SEEN_KNOWN = 3
"""Detections after which a landmark is known. After two of high score, precision of chairs is 0.42 instead of 0.48."""
_CERTAIN_SCORE = 0.9
"""Score from which one detection alone counts: the best one of a thing that does not exist had 0.75 in the kitchen."""
_WEAK_SHARE = 0.5
"""Weight of a weak detection among them: it raises the recall of a rarely found monitor from 0.40 to 0.87."""
_MIN_PRESENT_FRACTION = 0.5
"""Share of its frames that found a landmark, from which it is still there if the latest one misses it. With 1, the
recall of monitors is 0.42 instead of 0.50; with 0.33, the precision of sofas 0.90 instead of 0.91."""
_DEPTH_SLACK_M = 0.10
_DEPTH_SLACK_SHARE = 0.02
"""How far behind the measured depth a cell is still unoccluded, in metres and as a share of depth."""
_MIN_VISIBLE_SHARE = 0.6
"""Share of a landmark's cells that a frame shows that should detect it."""
_MAX_DISTANCE_RATIO = 1.1
"""Distance, relative to the farthest detection, up to which a frame should detect it."""
_NEAR_M = 0.05
"""Least depth that is projected; nearer points have no pixel."""


class LandmarkState(StrEnum):
    """How sure it is that a landmark exists.

    candidate: too few detections, too many misses, or rather a different thing. confirmed: it exists and is mapped.
    known: found so often that earlier frames get its mask.
    """

    CANDIDATE = "candidate"
    CONFIRMED = "confirmed"
    KNOWN = "known"


@dataclass(frozen=True, slots=True)
class Evidence:
    """Decides the state of a landmark by its counts alone, so that a state is never stored."""

    settings: EvidenceSettings

    def state(self, landmark: Landmark) -> LandmarkState:
        """Return how sure it is that a landmark exists; each detection or miss may change it."""
        if landmark.is_given:
            return LandmarkState.KNOWN
        seen, missed = landmark.seen_count, landmark.missed_count
        has_detections = (
            landmark.view_count >= self.settings.min_seen or landmark.best_score >= self.settings.confident_score
        )
        is_found = seen >= self.settings.min_seen_fraction * (seen + missed)  # ghosts of a detector appear in few views
        if not (has_detections and is_found) or self.rival(landmark) is not None:
            return LandmarkState.CANDIDATE
        is_known = seen + _WEAK_SHARE * landmark.weak_count >= _MIN_SEEN_KNOWN
        return LandmarkState.KNOWN if is_known else LandmarkState.CONFIRMED

    def confirmed(self, landmarks: Sequence[Landmark]) -> list[Landmark]:
        """Return the landmarks that are confirmed or known, without those in whose place another thing is surer."""
        found = [landmark for landmark in landmarks if self.state(landmark) is not LandmarkState.CANDIDATE]
        return [landmark for landmark in found if not any(_is_better_explained(other, landmark) for other in found)]

    def rival(self, landmark: Landmark) -> str | None:
        """Return the different thing that the landmark rather is by the sums of the scores; None if there is none."""
        if landmark.is_given:
            return None
        name, score = max(landmark.rival_scores.items(), key=lambda item: item[1], default=("", 0.0))
        return name if score > self.settings.max_rival_ratio * landmark.score_sum else None

    def is_witnessed(self, landmark: Landmark) -> bool:
        """Return True if it may be reported: one moment's detections are detail for the map, but no object yet."""
        is_certain = landmark.is_given or landmark.best_score >= _CERTAIN_SCORE
        return is_certain or landmark.view_count >= self.settings.min_seen

    def without_low_scores(self, landmarks: Sequence[Landmark]) -> list[Landmark]:
        """Return the landmarks whose confidence is not far below the best of their noun."""
        # ascending, so that the best confidence of each noun is the last one that the dictionary keeps
        best = dict(sorted((found.phrase, found.confidence) for found in landmarks if not found.is_given))
        least = self.settings.min_score_share
        return [found for found in landmarks if found.confidence >= least * best.get(found.phrase, 0.0)]

    def is_present(self, landmark: Landmark) -> bool:
        """Return True if the latest frame with detections found the landmark, or few of its frames missed it."""
        found = landmark.seen_count + landmark.weak_count
        is_often_found = found >= _MIN_PRESENT_FRACTION * (found + landmark.missed_count)
        return landmark.is_given or landmark.missed_in_a_row == 0 or is_often_found


def _is_better_explained(other: Landmark, landmark: Landmark) -> bool:
    """Return True if a landmark's place shows an object of another kind with more confidence."""
    return (
        other.phrase != landmark.phrase
        and other.confidence > landmark.confidence
        and landmark.may_equal(other)
        and not (same_kind(landmark.phrase, other.phrase) or same_kind(other.phrase, landmark.phrase))
    )


@dataclass(frozen=True, slots=True, eq=False)
class VisibilityCheck:
    """Decides whether a frame should show a landmark."""

    frame: Frame
    depth_m: Float32[ndarray, "h w"]  # the depth of the nearest surface in each pixel

    def is_visible(self, landmark: Landmark) -> bool:
        """Return True if most of the landmark's cells are in view, unoccluded and near enough to be detected.

        The cells of an object that was removed are also visible: the frame then shows the surface behind them.
        """
        distance_m = float(np.linalg.norm(landmark.centroid_m - self.frame.T_world_camera[:3, 3]))
        if distance_m > _MAX_DISTANCE_RATIO * landmark.farthest_m:  # too small in the image: a miss proves nothing
            return False
        cells = transform_points(inverse(self.frame.T_world_camera), landmark.footprint_m().astype(np.float64))
        z_m = cells[:, 2]
        in_front = np.column_stack([cells[:, :2], np.maximum(z_m, _NEAR_M)]).astype(np.float32)
        pixels = np.floor(project(in_front, self.frame.camera)).astype(np.int64)
        height, width = self.depth_m.shape
        inside = (z_m > _NEAR_M) & (pixels >= 0).all(axis=1) & (pixels < (width, height)).all(axis=1)
        columns, rows = pixels[inside].T
        sensed_m = self.depth_m[rows, columns]
        reach_m = sensed_m * (1.0 + _DEPTH_SLACK_SHARE) + _DEPTH_SLACK_M
        unoccluded = (sensed_m > 0) & (z_m[inside] <= reach_m)  # nothing was measured in front of it
        return bool(np.count_nonzero(unoccluded) >= _MIN_VISIBLE_SHARE * len(cells))
