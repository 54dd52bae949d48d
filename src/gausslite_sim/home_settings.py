"""Settings of a simulated home's sequence, as written in its spec."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any
from urllib.parse import parse_qsl

from gausslite.domain.errors import DatasetError, InvalidInputError
from gausslite.domain.lens import Lens

TRAJECTORY_COUNT = 3
_SIDES_PX = (16, 4096)
_NUMBER = r"-?[0-9]{1,2}(?:\.[0-9]{1,3})?"
_CHANGES = re.compile(rf"(\w+):(?:gone|({_NUMBER}):({_NUMBER})(?::({_NUMBER}))?)")
_NUMBERS = ("seed", "trajectory", "frames", "laps", "movers")
_STRENGTHS = ("noise", "exposure")
_UNITS = {
    "shutter": (r"[0-9]{1,3}(\.[0-9]{1,3})?ms", "readout_ms"),
    "blur": (r"[0-9]{1,3}(\.[0-9]{1,3})?ms", "exposure_ms"),
    "speed": (r"[0-9]{1,4}", "speed_deg_s"),
    "drift": (r"[0-9]{1,2}(\.[0-9]{1,3})?%", "drift_percent"),
}
"""Pattern and setting of numbers with a unit."""


@dataclass(frozen=True, slots=True)
class HomeSettings:
    """One trajectory through one home.

    noise: scale of the sensor model; 0 disables it, and depth is exact. exposure: scale of the gain drift. readout_ms:
    readout time of a rolling shutter. exposure_ms: exposure time of a row. lens: distortion of both images.
    speed_deg_s: mean angular speed, which sets the frame rate; 0 for 30 Hz. drift_percent: error of the odometry whose
    poses the frames have, in percent of the distance moved and of the angle turned; 0 for exact poses. laps: how often
    the path is walked, every second time backwards. changes: the objects that are not where the home has them, with
    their shift in metres, or None if they are gone. movers: boxes that move.
    """

    home: int = 0
    seed: int = 0
    trajectory: int = 0
    frames: int = 120
    size_px: tuple[int, int] = (320, 240)
    noise: float = 1.0
    exposure: float = 1.0
    readout_ms: float = 0.0
    exposure_ms: float = 0.0
    lens: Lens | None = None
    speed_deg_s: float = 0.0
    drift_percent: float = 0.0
    laps: int = 1
    changes: tuple[tuple[str, tuple[float, float, float] | None], ...] = ()
    movers: int = 0

    def __post_init__(self) -> None:
        low, high = _SIDES_PX
        for name, value, expected, valid in (
            ("seed", self.seed, "0 to 4294967295", 0 <= self.seed < 2**32),
            ("trajectory", self.trajectory, f"0 to {TRAJECTORY_COUNT - 1}", 0 <= self.trajectory < TRAJECTORY_COUNT),
            ("frames", self.frames, "1 to 100000", 1 <= self.frames <= 100_000),
            ("laps", self.laps, "1 to 100", 1 <= self.laps <= 100),
            ("movers", self.movers, "0 or 1", self.movers in (0, 1)),
            ("size", self.size_px, f"sides of {low} to {high} px", all(low <= side <= high for side in self.size_px)),
            ("shutter", self.readout_ms, "0ms to 100ms", 0.0 <= self.readout_ms <= 100.0),
            ("blur", self.exposure_ms, "0ms to 100ms", 0.0 <= self.exposure_ms <= 100.0),
            ("drift", self.drift_percent, "0% to 20%", 0.0 <= self.drift_percent <= 20.0),
            ("speed", self.speed_deg_s, "0 to 1000 degrees per second", 0.0 <= self.speed_deg_s <= 1000.0),
            *((name, getattr(self, name), "0 to 10", 0.0 <= getattr(self, name) <= 10.0) for name in _STRENGTHS),
        ):
            if not valid:
                raise DatasetError(f"{self.home_name}: {name}: expected {expected}, got {value}")

    @property
    def home_name(self) -> str:
        """The home's name in a spec: "sim:home-3"."""
        return name_of_home(self.home)

    @classmethod
    def parse(cls, query: str, home: int = 0) -> HomeSettings:
        """Parse "seed=0&trajectory=1&frames=120&size=320x240&noise=1"; all parts are optional. Raises DatasetError."""
        settings: dict[str, Any] = {}
        for key, value in parse_qsl(query, keep_blank_values=True):
            if key in _NUMBERS and re.fullmatch(r"[0-9]{1,10}", value):
                settings[key] = int(value)
            elif key in _STRENGTHS and re.fullmatch(r"[0-9]{1,3}(\.[0-9]{1,9})?", value):
                settings[key] = float(value)
            elif key == "size" and re.fullmatch(r"[0-9]{1,5}x[0-9]{1,5}", value):
                settings["size_px"] = tuple(int(side) for side in value.split("x"))
            elif key in _UNITS and re.fullmatch(_UNITS[key][0], value):
                settings[_UNITS[key][1]] = float(value.rstrip("ms%"))
            elif key == "lens":
                settings["lens"] = _read_lens(value, home)
            elif key == "changes" and all(_CHANGES.fullmatch(change) for change in value.split(",")):
                settings["changes"] = tuple(_read_change(change) for change in value.split(","))
            else:
                expected = "&".join(
                    [
                        *(f"{name}=N" for name in _NUMBERS),
                        *("size=WxH", "shutter=Xms", "blur=Xms", "lens=MODEL:K1,...", "speed=N", "drift=X%"),
                        "changes=OBJECT:gone,OBJECT:DX:DY[:DZ],...",
                        *(f"{name}=X" for name in _STRENGTHS),
                    ]
                )
                raise DatasetError(
                    f"{name_of_home(home)}: {key}={value}: expected {expected}, each optional; N whole, X 0 to 10"
                )
        return cls(home, **settings)


def _read_change(text: str) -> tuple[str, tuple[float, float, float] | None]:
    match = _CHANGES.fullmatch(text)
    assert match is not None
    name, *shift_m = match.groups()
    if shift_m[0] is None:
        return name, None
    x_m, y_m, z_m = (float(number or 0.0) for number in shift_m)
    return name, (x_m, y_m, z_m)


def _read_lens(text: str, home: int) -> Lens:
    try:
        return Lens.parse(text)
    except InvalidInputError as error:
        raise DatasetError(f"{name_of_home(home)}: {error}") from None


def name_of_home(home: int) -> str:
    """Return the home's name in a spec."""
    return f"sim:home-{home}" if home else "sim:home"
