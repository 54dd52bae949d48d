"""What a recording may leave open: lens and times of its camera, registration of its depth, errors of its poses."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.domain.camera import MAX_EXPOSURE_S, MAX_READOUT_S, Camera, FileIntrinsics
from gausslite.domain.checks import require_number, require_types
from gausslite.domain.errors import InvalidInputError
from gausslite.domain.lens import Lens
from gausslite.domain.pose import transform_of

_MAX_TIME_OFFSET_S = 1.0
_NAMES = ("lens", "readout", "offset", "exposure")
_MAX_BASELINE_M = 1.0
_MAX_ROTATION_DEG = 45.0
_MAX_STD = 1000.0
"""Upper bound of every standard deviation; its square is still a finite float."""


@dataclass(frozen=True, slots=True)
class CameraCorrection:
    """How recorded images differ from those of an ideal camera.

    readout_s: time from the exposure of the first row to that of the last; negative if rows are read from the bottom.
    Raises InvalidInputError.
    """

    lens: Lens | None = None
    readout_s: float = 0.0
    time_offset_s: float = 0.0  # add it to an image's stamp to get the trajectory's time of its middle row
    exposure_s: float = 0.0  # each row's exposure time, which blurs moving images; 0 for none

    def __post_init__(self) -> None:
        for name, value, low, high in (
            ("readout", self.readout_s, -MAX_READOUT_S, MAX_READOUT_S),
            ("time offset", self.time_offset_s, -_MAX_TIME_OFFSET_S, _MAX_TIME_OFFSET_S),
            ("exposure", self.exposure_s, 0.0, MAX_EXPOSURE_S),
        ):
            if not low <= value <= high:
                raise InvalidInputError(f"camera {name}: expected {low:g} to {high:g} s, got {value}")

    @classmethod
    def parse(cls, text: str) -> CameraCorrection:
        """Return the correction of "lens=MODEL:K1,...;readout=S;offset=S;exposure=S". Raises InvalidInputError."""
        parts: dict[str, str] = {}
        for part in text.split(";"):
            name, equals, value = part.strip().partition("=")
            if not equals or name in parts or name not in _NAMES:
                raise InvalidInputError(
                    "camera correction: expected lens=MODEL:K1,...;readout=S;offset=S;exposure=S, "
                    f"each at most once, got {text[:80]!r}"
                )
            parts[name] = value
        try:
            readout_s, time_offset_s, exposure_s = (float(parts.get(name, 0.0)) for name in _NAMES[1:])
        except ValueError:
            raise InvalidInputError(f"camera correction: expected times in seconds, got {text[:80]!r}") from None
        return cls(Lens.parse(parts["lens"]) if "lens" in parts else None, readout_s, time_offset_s, exposure_s)

    def __str__(self) -> str:
        """Return the text that `parse` reads."""
        parts = [] if self.lens is None else [f"lens={self.lens}"]
        parts += [f"readout={self.readout_s:g}"] if self.readout_s else []
        parts += [f"offset={self.time_offset_s:g}"] if self.time_offset_s else []
        parts += [f"exposure={self.exposure_s:g}"] if self.exposure_s else []
        return ";".join(parts) or "readout=0"

    @property
    def is_identity(self) -> bool:
        """True if images are used as recorded."""
        times_s = self.readout_s, self.time_offset_s, self.exposure_s
        return not any(times_s) and (self.lens is None or self.lens.is_identity)


@dataclass(frozen=True, slots=True)
class DepthRegistration:
    """The colour camera's intrinsics and T_colour_depth, for two cameras with about the same viewing direction.

    intrinsics: in the data set's convention (pixel centres at integers), for images of the sequence's own size.
    offset_m: translation of T_colour_depth, the depth camera's position in the colour camera's frame. rotation_deg:
    rotation vector of T_colour_depth (axis times angle). Raises InvalidInputError.
    """

    intrinsics: FileIntrinsics
    offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rotation_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        require_types(intrinsics=(self.intrinsics, FileIntrinsics))
        fx, fy, cx, cy = self.intrinsics.fx, self.intrinsics.fy, self.intrinsics.cx, self.intrinsics.cy
        if not all(math.isfinite(value) for value in (fx, fy, cx, cy)) or fx <= 0 or fy <= 0:
            given = f"{fx:g},{fy:g},{cx:g},{cy:g}"
            raise InvalidInputError(
                f"depth registration: expected finite FX,FY,CX,CY with focal lengths above 0, got {given}"
            )
        if not all(abs(value) <= _MAX_BASELINE_M for value in self.offset_m):
            given = ",".join(f"{value:g}" for value in self.offset_m)
            raise InvalidInputError(
                f"depth registration: expected TX,TY,TZ in metres, at most {_MAX_BASELINE_M:g} each, got {given}"
            )
        if not math.hypot(*self.rotation_deg) <= _MAX_ROTATION_DEG:
            given = ",".join(f"{value:g}" for value in self.rotation_deg)
            raise InvalidInputError(
                f"depth registration: expected RX,RY,RZ of at most {_MAX_ROTATION_DEG:g} degrees in all, got {given}"
            )

    @classmethod
    def parse(cls, text: str) -> DepthRegistration:
        """Return the registration of FX,FY,CX,CY[,TX,TY,TZ[,RX,RY,RZ]] (px, m, deg). Raises InvalidInputError."""
        try:
            values = [float(part) for part in text.split(",")]
        except ValueError:
            values = []
        if len(values) not in (4, 7, 10):
            raise InvalidInputError(f"depth registration: expected FX,FY,CX,CY[,TX,TY,TZ[,RX,RY,RZ]], got {text!r}")
        x, y, z, *rotation = (*values[4:], *(0.0,) * (10 - len(values)))
        return cls(FileIntrinsics(*values[:4]), (x, y, z), (rotation[0], rotation[1], rotation[2]))

    def __str__(self) -> str:
        """Return the text that `parse` reads."""
        k = self.intrinsics
        return ",".join(f"{value:.10g}" for value in (k.fx, k.fy, k.cx, k.cy, *self.offset_m, *self.rotation_deg))

    def extrinsics(self) -> Float64[ndarray, "4 4"]:
        """Return T_colour_depth: p_colour = T_colour_depth @ p_depth."""
        return transform_of(np.concatenate([self.offset_m, np.radians(self.rotation_deg)]))

    def scaled(self, x_factor: float, y_factor: float) -> DepthRegistration:
        """Return the registration for images larger by these factors."""
        return replace(self, intrinsics=self.intrinsics.scaled(x_factor, y_factor))

    def camera(self, width_px: int, height_px: int) -> Camera:
        """Return the colour camera (pixel centres at +0.5)."""
        return self.intrinsics.camera("depth registration", width_px, height_px)


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
            require_number(f"pose prior {name}", getattr(self, name))
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
