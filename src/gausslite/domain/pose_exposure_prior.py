"""Prior on the pose and exposure error of one view: how far a recorded pose and its colours may be off."""

from __future__ import annotations

from dataclasses import dataclass

from gausslite.domain.errors import InvalidInputError

_MAX_STD = 1000.0
"""Upper bound of every standard deviation; its square is still a finite float."""


@dataclass(frozen=True, slots=True)
class PoseExposurePrior:
    """Standard deviations of a view's pose and exposure error; 0, the default, keeps the recorded value.

    translation_m, rotation_deg: pose error along and about each camera axis. gain, offset: exposure error around 1 and
    0, for colours in [0, 1]. Raises InvalidInputError for a value outside 0 to 1000.
    """

    translation_m: float = 0.0
    rotation_deg: float = 0.0
    gain: float = 0.0
    offset: float = 0.0

    def __post_init__(self) -> None:
        for name in ("translation_m", "rotation_deg", "gain", "offset"):
            if not 0 <= getattr(self, name) <= _MAX_STD:
                raise InvalidInputError(f"pose prior {name}: expected 0 to {_MAX_STD:g}, got {getattr(self, name)}")

    @classmethod
    def parse(cls, text: str) -> PoseExposurePrior:
        """Return the prior written as "M,DEG" or "M,DEG,GAIN,OFFSET". Raises InvalidInputError."""
        try:
            values = [float(part) for part in text.split(",")]
        except ValueError:
            values = []
        if len(values) not in (2, 4):
            raise InvalidInputError(f"pose prior: expected M,DEG or M,DEG,GAIN,OFFSET, got {text[:40]!r}")
        return cls(*values)

    def __str__(self) -> str:
        """Return the text that `parse` reads."""
        return f"{self.translation_m:g},{self.rotation_deg:g},{self.gain:g},{self.offset:g}"

    @property
    def is_exact(self) -> bool:
        """True if poses and colours are used without correction."""
        return not self.has_pose_error and not self.has_exposure_error

    @property
    def has_pose_error(self) -> bool:
        """True if poses may be corrected."""
        return self.translation_m > 0 or self.rotation_deg > 0

    @property
    def has_exposure_error(self) -> bool:
        """True if colours may be corrected."""
        return self.gain > 0 or self.offset > 0


TRACKED_PRIOR = PoseExposurePrior(translation_m=0.01, rotation_deg=0.5, gain=0.1, offset=0.03)
"""Prior for poses that were tracked against a map that still grows."""
HANDHELD_PRIOR = PoseExposurePrior(translation_m=0.03, rotation_deg=1.0, gain=0.2, offset=0.06)
"""Prior for a hand-held camera whose poses come from another sensor; also the upper bound of every fit."""
