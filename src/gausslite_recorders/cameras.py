"""Read the camera of files that other tools write beside images: COLMAP, SensReader, Open3D, ETH3D, ORB-SLAM.

Each reader of the group `gausslite.cameras` is a `CameraReader` of the core.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from gausslite.datasets.camera_files import FolderCamera, lens_of, read_matrix
from gausslite.datasets.files import is_number, parse_numbers, read_rows, read_text
from gausslite.domain.camera import FileIntrinsics
from gausslite.domain.errors import DatasetError


@dataclass(frozen=True, slots=True)
class FormatReader:
    """A CameraReader: patterns of the names of a format's files, and the function that reads one."""

    patterns: tuple[str, ...]
    read: Callable[[Path, int, int], FolderCamera | None]


_COLMAP_LENSES: Mapping[str, Callable[[Sequence[float]], tuple[float, ...]]] = {
    "SIMPLE_PINHOLE": lambda p: (p[0], p[0], p[1], p[2]),
    "PINHOLE": lambda p: (p[0], p[1], p[2], p[3]),
    "SIMPLE_RADIAL": lambda p: (p[0], p[0], p[1], p[2], p[3], 0.0, 0.0, 0.0),
    "RADIAL": lambda p: (p[0], p[0], p[1], p[2], p[3], p[4], 0.0, 0.0),
    "OPENCV": lambda p: tuple(p[:8]),
    "FULL_OPENCV": lambda p: tuple(p[:12]),
    "OPENCV_FISHEYE": lambda p: tuple(p[:8]),
    "SIMPLE_RADIAL_FISHEYE": lambda p: (p[0], p[0], p[1], p[2], p[3], 0.0, 0.0, 0.0),
    "RADIAL_FISHEYE": lambda p: (p[0], p[0], p[1], p[2], p[3], p[4], 0.0, 0.0),
}
"""Parameters of COLMAP's camera models as fx fy cx cy and OpenCV's distortion coefficients."""


def read_colmap(path: Path, _width_px: int, _height_px: int) -> FolderCamera:
    """Return the camera of COLMAP's cameras.txt, whose principal point counts from the image corner.

    Raises DatasetError, also for several cameras that differ: which one took an image is not in this file.
    """
    rows = read_rows(path)
    location, fields = rows[0] if rows else (str(path), [])
    others = sum(other[1:] != fields[1:] for _, other in rows[1:])
    if others:
        raise DatasetError(
            f"{path}: expected one camera, got {1 + others} that differ; leave the one that took the images"
        )
    model = fields[1] if len(fields) > 1 else ""
    if model not in _COLMAP_LENSES:
        raise DatasetError(
            f"{location}: expected ID MODEL WIDTH HEIGHT PARAMETERS with a model of "
            f"{', '.join(_COLMAP_LENSES)}, got {model[:30]!r}"
        )
    numbers = parse_numbers(location, fields[2:], len(fields) - 2, "a camera's size and parameters")
    try:
        fx, fy, cx, cy, *distortion = _COLMAP_LENSES[model](numbers[2:])
    except (IndexError, ValueError):
        raise DatasetError(f"{location}: expected more parameters for {model}, got {len(numbers) - 2}") from None
    lens = lens_of(str(path), "equidistant" if model.endswith("FISHEYE") else "plumb_bob", distortion)
    camera = FileIntrinsics(fx, fy, cx - 0.5, cy - 0.5).camera(str(path), int(numbers[0]), int(numbers[1]))
    return FolderCamera(camera, lens=lens)


def read_sensor_info(path: Path, width_px: int, height_px: int) -> FolderCamera | None:
    """Return the camera of SensReader's and BundleFusion's info.txt, with its unit of depth; None for other texts.

    Intrinsics of another size than that of the images belong to images before they were resized. Raises DatasetError.
    """
    found = dict(re.findall(r"^\s*(m_\w+)\s*=\s*(.*?)\s*$", read_text(path), re.MULTILINE))
    if "m_calibrationColorIntrinsic" not in found:
        return None
    matrix = parse_numbers(
        f"{path}: m_calibrationColorIntrinsic", found["m_calibrationColorIntrinsic"].split(), 16, "4x4"
    )
    sides = [found.get(f"m_color{side}", size) for side, size in (("Width", width_px), ("Height", height_px))]
    width, height = parse_numbers(f"{path}: m_colorWidth, m_colorHeight", list(map(str, sides)), 2, "a size")
    camera = FileIntrinsics(matrix[0], matrix[5], matrix[2], matrix[6]).camera(str(path), int(width), int(height))
    shift = found.get("m_depthShift", "")
    units = parse_numbers(f"{path}: m_depthShift", [shift], 1, "depth units per metre")[0] if shift else None
    return FolderCamera(camera.resized(width_px, height_px), units)


def read_open3d(path: Path, _width_px: int, _height_px: int) -> FolderCamera | None:
    """Return the camera of Open3D's PinholeCameraIntrinsic as JSON; None for other texts. Raises DatasetError."""
    try:
        fields = json.loads(read_text(path))
        if "intrinsic_matrix" not in fields:
            return None
        # by columns
        fx, _, _, _, fy, _, cx, cy, _ = map(float, fields["intrinsic_matrix"])
        width, height = int(fields["width"]), int(fields["height"])
    except (ValueError, KeyError, TypeError) as error:
        raise DatasetError(
            f"{path}: expected width, height and an intrinsic_matrix of 9 numbers with decimal points; {error!r}"
        ) from None
    return FolderCamera(FileIntrinsics(fx, fy, cx, cy).camera(str(path), width, height))


def read_eth3d(path: Path, width_px: int, height_px: int) -> FolderCamera | None:
    """Return the camera of ETH3D's calibration.txt (fx fy cx cy); None for other texts. Raises DatasetError."""
    rows = read_rows(path)
    if len(rows) != 1 or len(rows[0][1]) != 4 or not all(map(is_number, rows[0][1])):
        return None
    intrinsics = FileIntrinsics(*parse_numbers(*rows[0], 4, "fx fy cx cy"))
    return FolderCamera(intrinsics.camera(str(path), width_px, height_px))


_COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3")


def read_orb_slam(path: Path, width_px: int, height_px: int) -> FolderCamera | None:
    """Return the camera of ORB-SLAM's settings (Camera.fx or Camera1.fx), with its unit of depth; None for other texts.

    Raises DatasetError.
    """
    text = read_text(path)
    found = dict(re.findall(r"^\s*(?:Camera1?|RGBD)\.(\w+)\s*:\s*([^\s#]+)", text, re.MULTILINE))
    found |= dict(re.findall(r"^\s*(DepthMapFactor)\s*:\s*([^\s#]+)", text, re.MULTILINE))
    if "fx" not in found:
        return None

    def numbers(*names: str) -> list[float]:
        missing = [name for name in names if name not in found]
        if missing:
            raise DatasetError(f"{path}: expected Camera.{missing[0]}, got none")
        return parse_numbers(f"{path}: {', '.join(names)}", [found[name] for name in names], len(names), "a camera")

    width, height = map(int, numbers("width", "height")) if "width" in found else (width_px, height_px)
    camera = FileIntrinsics(*numbers("fx", "fy", "cx", "cy")).camera(str(path), width, height)
    is_fisheye = "KannalaBrandt" in found.get("type", "") or "KannalaBrandt" in text
    names = ("k1", "k2", "k3", "k4") if is_fisheye else _COEFFICIENTS
    coefficients = [numbers(name)[0] if name in found else 0.0 for name in names]
    units = numbers("DepthMapFactor")[0] if "DepthMapFactor" in found else None
    lens = lens_of(str(path), "equidistant" if is_fisheye else "plumb_bob", coefficients)
    return FolderCamera(camera.resized(width_px, height_px), units, lens)


def read_other_matrix(path: Path, width_px: int, height_px: int) -> FolderCamera | None:
    """Return the camera of a 3x3 matrix, of colour, under another name; None for other texts."""
    if "depth" in path.name.lower():
        return None
    try:
        camera = read_matrix(path).camera(str(path), width_px, height_px)
    except DatasetError:
        return None
    return FolderCamera(camera, note=f"the camera is the matrix of {path.name}")


COLMAP: Final = FormatReader(("cameras.txt",), read_colmap)
SENSOR_INFO: Final = FormatReader(("info.txt", "_info.txt"), read_sensor_info)
OPEN3D: Final = FormatReader(("*intrinsic*.json", "camera_primesense.json", "camera.json"), read_open3d)
ETH3D: Final = FormatReader(("calibration.txt",), read_eth3d)
ORB_SLAM: Final = FormatReader(("*.yaml", "*.yml"), read_orb_slam)
MATRIX: Final = FormatReader(("*ntrinsic*.txt", "*K.txt"), read_other_matrix)
"""The readers of the group `gausslite.cameras`."""
