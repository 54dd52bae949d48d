"""How recorded images differ from those of an ideal camera: lens, rolling shutter, time offset and exposure time."""

from __future__ import annotations

from dataclasses import dataclass

from gausslite.domain.camera_motion import MAX_EXPOSURE_S, MAX_READOUT_S
from gausslite.domain.errors import InvalidInputError
from gausslite.domain.lens import Lens

_MAX_TIME_OFFSET_S = 1.0
_NAMES = ("lens", "readout", "offset", "exposure")


@dataclass(frozen=True, slots=True)
class CameraCorrection:
    """How recorded images differ from those of an ideal camera.

    readout_s: time from the exposure of the first row to that of the last; negative if rows are read from the bottom.
    time_offset_s: add it to an image's stamp to get the trajectory's time of its middle row. exposure_s: each row's
    exposure time, which blurs moving images; 0 for none. Raises InvalidInputError.
    """

    lens: Lens | None = None
    readout_s: float = 0.0
    time_offset_s: float = 0.0
    exposure_s: float = 0.0

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
        """Return the correction of "lens=MODEL:K1,...;readout=S;offset=S;exposure=S", each part optional.

        Raises InvalidInputError.
        """
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
