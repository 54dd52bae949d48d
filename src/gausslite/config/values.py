"""Read the values of options that have a text form of their own, and write them."""

from __future__ import annotations

import argparse
import json
import math
import re
from collections.abc import Mapping, Sequence
from enum import Enum
from operator import attrgetter
from pathlib import Path
from typing import Any, get_args, get_origin

from gausslite.domain.checks import require_instance, require_number, require_whole
from gausslite.domain.errors import InvalidInputError
from gausslite.domain.pose import UpAxis
from gausslite.domain.recording import CameraCorrection, DepthRegistration, PoseExposurePrior
from gausslite.domain.relevance import BallRegion
from gausslite.domain.voxels import MAX_VOXEL_M, MIN_VOXEL_M, VoxelGrid

AUTO, NONE = "auto", "none"


CAMERA_FORM = "FX,FY,CX,CY[,TX,TY,TZ[,RX,RY,RZ]]"
CORRECTION_FORM = "lens=MODEL:K1,...;readout=S;offset=S"
PRIOR_FORM = "M,DEG[,GAIN,OFFSET]"
VOXEL_SIZE: Mapping[str, Any] = {
    "key": "voxel-size",
    "unit": "m",
    "low": MIN_VOXEL_M,
    "high": MAX_VOXEL_M,
    "plain_type": float,
    "convert": VoxelGrid,
    "to_plain": attrgetter("size_m"),
}
"""The declaration of an option whose field is a grid."""


def read_text(text: str) -> str:
    """Return the text. Raises InvalidInputError if it is empty."""
    if not text:
        raise InvalidInputError("expected a text, got an empty one")
    return text


def read_path(text: str) -> Path:
    """Return the path. Raises InvalidInputError for an empty text, which would stand for the current folder."""
    if not text:
        raise InvalidInputError("path: expected the name of a file or folder, got an empty text")
    return Path(text)


def read_numbers(text: str, count: int) -> list[float]:
    """Return exactly `count` finite numbers of "1,2". Raises ArgumentTypeError."""
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) != count or not all(math.isfinite(value) for value in values):
        raise argparse.ArgumentTypeError(f"expected {count} finite numbers separated by commas, got {text!r}")
    return values


def read_up_axis(text: str) -> UpAxis:
    """Return the axis of "x,y,z". Raises ArgumentTypeError."""
    x, y, z = read_numbers(text, 3)
    return (x, y, z)


def write_numbers(values: Sequence[float]) -> str:
    """Return the text that `read_numbers` reads."""
    return ",".join(f"{value:.17g}" for value in values)


def read_balls(texts: Sequence[str]) -> tuple[BallRegion, ...]:
    """Return the balls of "x,y,z,r", in metres. Raises ArgumentTypeError, InvalidInputError."""
    balls = []
    for text in texts:
        x, y, z, radius_m = read_numbers(text, 4)
        balls.append(BallRegion((x, y, z), radius_m))
    return tuple(balls)


def write_balls(balls: Sequence[BallRegion]) -> list[str]:
    """Return the texts that `read_balls` reads."""
    return [write_numbers((*ball.centre_m, ball.radius_m)) for ball in balls]


def read_registration(text: str) -> DepthRegistration | None:
    """Return the camera to register depth to, None for NONE. Raises InvalidInputError."""
    return None if text == NONE else DepthRegistration.parse(text)


def read_registration_or_auto(text: str) -> DepthRegistration | str:
    """Return AUTO, NONE or a camera. Raises InvalidInputError."""
    return text if text in (AUTO, NONE) else DepthRegistration.parse(text)


def read_correction(text: str) -> CameraCorrection:
    """Return the correction of NONE (images as recorded) or of its text form. Raises InvalidInputError."""
    return CameraCorrection() if text == NONE else CameraCorrection.parse(text)


def write_correction(correction: CameraCorrection | str) -> str:
    """Return the text that `read_correction` reads; AUTO stays."""
    return NONE if isinstance(correction, CameraCorrection) and correction.is_identity else str(correction)


def read_correction_or_auto(text: str) -> CameraCorrection | str:
    """Return AUTO, or the correction that `read_correction` returns. Raises InvalidInputError."""
    return text if text == AUTO else read_correction(text)


def read_prior(text: str) -> PoseExposurePrior:
    """Return the prior of NONE (exact poses) or of numbers. Raises InvalidInputError."""
    return PoseExposurePrior() if text == NONE else PoseExposurePrior.parse(text)


def write_prior(prior: PoseExposurePrior | str) -> str:
    """Return the text that `read_prior` reads; AUTO stays."""
    return NONE if isinstance(prior, PoseExposurePrior) and prior.is_exact else str(prior)


def read_prior_or_auto(text: str) -> PoseExposurePrior | str:
    """Return AUTO, or the prior that `read_prior` returns. Raises InvalidInputError."""
    return text if text == AUTO else read_prior(text)


Plain = str | bool | int | float | Sequence[str] | None
"""The value of one option in a configuration file; None leaves the option out."""

_BOOLEANS = {**dict.fromkeys(("1", "true", "yes", "on"), True), **dict.fromkeys(("0", "false", "no", "off"), False)}
_URL_PASSWORD = re.compile(r"(?<=://)([^/@\s:]*):[^/@\s]+(?=@)")


def split_names(text: str) -> tuple[str, ...]:
    """Return the parts of "a,b" without surrounding spaces."""
    return tuple(part.strip() for part in text.split(",") if part.strip())


def read_plain(kind: Any, value: object, *, is_toml: bool = False) -> Any:
    """Return the value of a type from text or, with is_toml, from a value of TOML.

    Raises InvalidInputError with what was expected; the caller adds the name.
    """
    if kind is bool:
        return _read_bool(value, is_toml)
    if kind in (int, float):
        return _read_number(kind, value, is_toml)
    if get_origin(kind) in (tuple, frozenset):
        return _read_parts(kind, value)
    if not isinstance(value, str):
        raise InvalidInputError(f"expected text, got {value!r}")
    if isinstance(kind, type) and issubclass(kind, Enum):
        names = [str(member.value) for member in kind]
        if value not in names:
            raise InvalidInputError(f"expected one of {', '.join(names)}, got {value!r}")
        return kind(value)
    if kind is Path:
        if not value:
            raise InvalidInputError("expected a path, got an empty text")
        return Path(value)
    return value


def require_plain(
    name: str, value: object, kind: Any, low: float | None, high: float | None, unit: str, choices: Sequence[str]
) -> None:
    """Raise InvalidInputError unless a value has the type, lies within the bounds and is one of the choices."""
    if kind is int:
        require_whole(name, value)
    elif kind is float:
        require_number(name, value)
    elif get_origin(kind) is frozenset:
        require_instance(name, value, (frozenset, set), "a set of names such as frozenset({'sb'})")
    elif isinstance(kind, type):
        require_instance(name, value, kind, "text" if kind is str else f"a {kind.__name__}")
    if isinstance(value, int | float) and not isinstance(value, bool) and not is_within(value, low, high):
        raise InvalidInputError(f"{name}: expected {describe_range(low, high, unit)}, got {value}")
    if choices and value not in choices:
        raise InvalidInputError(f"{name}: expected one of {', '.join(choices)}, got {value!r}")


def is_within(value: float, low: float | None, high: float | None) -> bool:
    """Return True for a number between the bounds, both included; never for NaN."""
    return not math.isnan(value) and (low is None or value >= low) and (high is None or value <= high)


def describe_range(low: float | None, high: float | None, unit: str = "") -> str:
    """Return "0 to 10 s", "at least 1" or "at most 5"; empty without bounds."""
    if low is None and high is None:
        return ""
    text = f"{_number(low)} to {_number(high)}" if low is not None and high is not None else ""
    text = text or (f"at least {_number(low)}" if low is not None else f"at most {_number(high)}")
    return f"{text} {unit}".rstrip()


def without_password(text: str) -> str:
    """Return the text with "***" in place of a URL's password."""
    return _URL_PASSWORD.sub(r"\1:***", text)


def to_toml(values: Mapping[str, Plain]) -> str:
    """Return one `key = value` line per value that is not None; `tomllib` reads it back."""
    return "".join(f"{key} = {_literal(value)}\n" for key, value in values.items() if value is not None)


def _read_bool(value: object, is_toml: bool) -> bool:
    if isinstance(value, bool):
        return value
    if isinstance(value, str) and not is_toml and value.lower() in _BOOLEANS:
        return _BOOLEANS[value.lower()]
    raise InvalidInputError(f"expected true or false, got {value!r}")


def _read_number(kind: type[int] | type[float], value: object, is_toml: bool) -> int | float:
    if is_toml:
        if isinstance(value, (int, float) if kind is float else int) and not isinstance(value, bool):
            return kind(value)
    elif isinstance(value, str):
        try:
            return kind(value)
        except ValueError:
            pass
    expected = "a whole number" if kind is int else "a number"
    raise InvalidInputError(f"expected {expected}, got {value!r}")


def _read_parts(kind: Any, value: object) -> Any:
    """Return the parts of "a,b" or of an array, with the type's element."""
    parts = split_names(value) if isinstance(value, str) else value
    if not isinstance(parts, list | tuple):
        raise InvalidInputError(f"expected a list of texts, got {value!r}")
    element = get_args(kind)[0]
    container: Any = get_origin(kind)
    return container(read_plain(element, part) for part in parts)


def _number(bound: float | None) -> str:
    return "" if bound is None else str(int(bound)) if bound == int(bound) else f"{bound:g}"


def _literal(value: str | bool | int | float | Sequence[str]) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, str):
        # JSON's escapes are TOML's, except that TOML refuses a bare DEL and lone surrogates
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    return f"[{', '.join(_literal(part) for part in value)}]"
