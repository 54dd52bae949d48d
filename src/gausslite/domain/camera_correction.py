"""How recorded images differ from those of an ideal camera: lens, rolling shutter and time offset."""

from __future__ import annotations

from dataclasses import dataclass

from gausslite.domain.errors import InvalidInputError
from gausslite.domain.lens import Lens

_MAX_READOUT_S, _MAX_TIME_OFFSET_S = 0.1, 1.0


@dataclass(frozen=True, slots=True)
class CameraCorrection:
    """How recorded images differ from those of an ideal camera.

    readout_s: time from the exposure of the first row to that of the last; negative if rows are read from the bottom.
    time_offset_s: add it to an image's stamp to get the trajectory's time of its middle row. Raises InvalidInputError.
    """

    lens: Lens | None = None
    readout_s: float = 0.0
    time_offset_s: float = 0.0

    def __post_init__(self) -> None:
        for name, value, limit in (
            ("readout", self.readout_s, _MAX_READOUT_S),
            ("time offset", self.time_offset_s, _MAX_TIME_OFFSET_S),
        ):
            if not abs(value) <= limit:
                raise InvalidInputError(f"camera {name}: expected -{limit:g} to {limit:g} s, got {value}")

    @classmethod
    def parse(cls, text: str) -> CameraCorrection:
        """Return the correction of "lens=MODEL:K1,...;readout=S;offset=S", each part optional.

        Raises InvalidInputError.
        """
        parts: dict[str, str] = {}
        for part in text.split(";"):
            name, equals, value = part.strip().partition("=")
            if not equals or name in parts or name not in ("lens", "readout", "offset"):
                raise InvalidInputError(
                    "camera correction: expected lens=MODEL:K1,...;readout=S;offset=S, each at most once, "
                    f"got {text[:80]!r}"
                )
            parts[name] = value
        try:
            readout_s, time_offset_s = (float(parts.get(name, 0.0)) for name in ("readout", "offset"))
        except ValueError:
            raise InvalidInputError(f"camera correction: expected times in seconds, got {text[:80]!r}") from None
        return cls(Lens.parse(parts["lens"]) if "lens" in parts else None, readout_s, time_offset_s)

    def __str__(self) -> str:
        """Return the text that `parse` reads."""
        parts = [] if self.lens is None else [f"lens={self.lens}"]
        parts += [f"readout={self.readout_s:g}"] if self.readout_s else []
        parts += [f"offset={self.time_offset_s:g}"] if self.time_offset_s else []
        return ";".join(parts) or "readout=0"

    @property
    def is_identity(self) -> bool:
        """True if images are used as recorded."""
        return self.readout_s == 0.0 and self.time_offset_s == 0.0 and (self.lens is None or self.lens.is_identity)
