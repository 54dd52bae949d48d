"""The address of a bag: its path, and the options that choose topics and frames."""

from __future__ import annotations

import re
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl

from gausslite.domain.errors import DatasetError

PREFIX = "bag:"
_SUFFIXES = (".bag", ".mcap", ".db3")
_METADATA = "metadata.yaml"
_TOLERANCE = re.compile(r"([0-9]{1,4}(?:\.[0-9]{1,3})?)ms")
_AXES = ("optical", "body")


@dataclass(frozen=True, slots=True)
class BagOptions:
    """Topics and frames of a bag, as written in its address; an empty text leaves the choice to the reader.

    color, depth: image topics. color_info, depth_info: their camera_info topics. odom: a topic with poses, used instead
    of tf. body: the frame whose pose that topic states. frame: the world frame in tf. camera: the colour camera's
    frame. axes: "optical" (z forward) or "body" (x forward), the convention of the camera frames. tolerance_s: largest
    difference of the stamps of a colour and a depth image.
    """

    color: str = ""
    depth: str = ""
    color_info: str = ""
    depth_info: str = ""
    odom: str = ""
    body: str = ""
    frame: str = ""
    camera: str = ""
    axes: str = "optical"
    tolerance_s: float = 0.020


@dataclass(frozen=True, slots=True)
class BagAddress:
    """Where a bag is, and how to read it."""

    path: Path
    options: BagOptions = BagOptions()

    @classmethod
    def parse(cls, spec: str) -> BagAddress | None:
        """Return the address of "bag:PATH?color=TOPIC&...", or of a path that is a bag; None for other sources.

        Raises DatasetError for unknown options, and if there is no bag behind the prefix.
        """
        text = spec.removeprefix(PREFIX)
        name, _, query = text.partition("?")
        if Path(text).expanduser().exists():
            # a name may have a question mark
            name, query = text, ""
        path = Path(name).expanduser()
        if not _is_bag(path):
            if spec.startswith(PREFIX):
                raise DatasetError(f"{spec}: {_reason(path)}")
            return None
        return cls(path, _parse_options(spec, query))


def _is_bag(path: Path) -> bool:
    if path.is_dir():
        return (path / _METADATA).is_file()
    return path.is_file() and path.suffix in _SUFFIXES


def _reason(path: Path) -> str:
    expected = f"expected a bag: a file {', '.join('*' + suffix for suffix in _SUFFIXES)}, or a folder with {_METADATA}"
    if path.is_dir():
        return f"{expected}; got a folder without it"
    return f"{expected}; got {'a file ' + path.name if path.exists() else 'nothing there'}"


def _parse_options(spec: str, query: str) -> BagOptions:
    names = [field.name for field in fields(BagOptions) if field.name not in ("tolerance_s", "axes")]
    chosen: dict[str, Any] = {}
    for key, value in parse_qsl(query, keep_blank_values=True):
        if (key in names and value) or (key == "axes" and value in _AXES):
            chosen[key] = value
        elif key == "tolerance" and (match := _TOLERANCE.fullmatch(value)):
            chosen["tolerance_s"] = float(match.group(1)) / 1000
        else:
            expected = "&".join([*(f"{name}=..." for name in names), f"axes={'|'.join(_AXES)}", "tolerance=Xms"])
            raise DatasetError(f"{spec}: {key}={value}: expected {expected}, each optional")
    return BagOptions(**chosen)
