"""Settings of perception that callers vary; the other limits are constants beside their step.

Their figures are of `gausslite bench perception` (docs/perception.md); one without a figure bounds time or memory.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING

import numpy as np

from gausslite.domain.errors import InvalidInputError
from gausslite.domain.pose import UpAxis, unit_up_axis

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

_SHARES = ("_share", "_score", "_iou", "_fraction", "_similarity", "_margin")


def require_plausible(section: str, settings: DataclassInstance, names: Iterable[str] | None = None) -> None:
    """Raise InvalidInputError for one of these fields, or of all, that is a share outside 0 to 1 or not positive."""
    for name in names or [declared.name for declared in fields(settings)]:
        value = getattr(settings, name)
        if isinstance(value, bool) or not isinstance(value, int | float):
            continue
        if name.endswith(_SHARES):
            if not 0.0 <= value <= 1.0:
                raise InvalidInputError(f"{section} {name}: expected 0 to 1, got {value}")
        elif not value > 0:
            raise InvalidInputError(f"{section} {name}: expected a positive number, got {value}")


@dataclass(frozen=True, slots=True)
class EvidenceSettings:
    """When a landmark is confirmed and when it is known, and which frames should show it.

    A landmark is confirmed after min_seen independent detections, or one of confident_score or more. Of the frames that
    should show it, at least min_seen_fraction must have detected it. Its scores must sum to at least 1 /
    max_rival_ratio of those of any different thing detected in its place: the nearest class of a detector is not always
    the class of the object.
    Its best score must be at least min_score_share of the best score among the objects of its target: jars are detected
    as bottles, with lower scores than the bottles.
    """

    min_seen: int = 2
    confident_score: float = 0.6
    min_seen_fraction: float = 0.25
    max_rival_ratio: float = 1.3
    min_score_share: float = 0.45

    def __post_init__(self) -> None:
        require_plausible("evidence", self)

    @classmethod
    def accept_similar(cls) -> EvidenceSettings:
        """Return settings that also confirm objects that are rather a different thing."""
        return cls(max_rival_ratio=np.inf, min_score_share=0.0)


@dataclass(frozen=True, slots=True)
class RelevanceTrackerSettings:
    """All sections, and when to detect: the limits of the camera's motion (a comment in Sec. III-B.2) and of frames.

    max_translation_m, max_rotation_deg, max_frames: between two detections.
    """

    up_axis: UpAxis = (0.0, -1.0, 0.0)  # up in the world frame, by default that of a level first camera
    max_translation_m: float = 1.0
    max_rotation_deg: float = 15.0
    max_frames: int = 5
    evidence: EvidenceSettings = field(default_factory=EvidenceSettings)

    def __post_init__(self) -> None:
        require_plausible("relevance", self)
        unit_up_axis(self.up_axis)
