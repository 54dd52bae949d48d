"""Read the camera of a folder's or bag's file: JSON with depth units, ROS's camera_info, a matrix, others' formats."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol, cast

import numpy as np

from gausslite.datasets.files import parse_numbers, read_rows, read_text
from gausslite.domain.camera import Camera, FileIntrinsics
from gausslite.domain.errors import DatasetError, InvalidInputError
from gausslite.domain.lens import Lens, LensModel
from gausslite.plugins import Group, installed

INTRINSICS_FILE = "camera-intrinsics.txt"
CAMERA_FILE = "cam_params.json"
CAMERA_INFO_FILES = ("camera_info.yaml", "camera_info.yml")
_MIN_UNITS_PER_METRE = 0.1
"""Smaller values are metres per unit, the reciprocal."""
_LENS_MODELS = {
    **dict.fromkeys(("plumbbob", "rationalpolynomial", "radtan", "radialtangential", "opencv"), LensModel.RADTAN),
    **dict.fromkeys(("brownconrady", "modifiedbrownconrady", "inversebrownconrady"), LensModel.RADTAN),
    **dict.fromkeys(("equidistant", "fisheye", "opencvfisheye", "kb4"), LensModel.FISHEYE),
    **dict.fromkeys(("kannalabrandt", "kannalabrandt4", "kannalabrandt8"), LensModel.FISHEYE),
}
"""Names of ROS, Kalibr, OpenCV, ORB-SLAM, Basalt and the RealSense SDK, in lower case, without marks between words."""
_WITHOUT_LENS = ("", "none", "pinhole", "ideal", "undistorted", "rectified")
_MAX_COEFFICIENTS = {LensModel.RADTAN: 8, LensModel.FISHEYE: 4}


def example_camera_file(width_px: int, height_px: int) -> str:
    """Return the name and the form of a camera file for images of this size, for messages."""
    size = f'"w": {width_px}, "h": {height_px}'
    return f'{CAMERA_FILE} ({{"camera": {{{size}, "fx": FX, "fy": FY, "cx": CX, "cy": CY, "scale": UNITS_PER_METRE}}}})'


def find_in_or_above(folder: Path, name: str) -> Path | None:
    """Return the file of this name in the folder or in its parent, or None."""
    return next((path for path in (folder / name, folder.absolute().parent / name) if path.is_file()), None)


@dataclass(frozen=True, slots=True)
class FolderCamera:
    """Camera that a folder's files state."""

    camera: Camera
    units_per_metre: float | None = None  # of the depth images, None if the file states none
    lens: Lens | None = None
    note: str = ""  # message that names a file of another folder; empty if the camera's file is the recording's own
    depth_registered: bool | None = None  # whether each depth pixel belongs to the colour pixel at its place


class CameraReader(Protocol):
    """Reads the camera of another tool's files. A package registers it in the group `gausslite.cameras`."""

    @property
    def patterns(self) -> tuple[str, ...]:
        """Patterns of the files' names."""

    def read(self, path: Path, width_px: int, height_px: int, /) -> FolderCamera | None:
        """Return the camera for images of this size; None for a file of another kind. Raises DatasetError."""


def read_folder_camera(
    folder: Path, width_px: int, height_px: int, published: FolderCamera | None = None
) -> FolderCamera | None:
    """Return the camera of a file in the folder, else the published one, else that of a file one folder above.

    A file above may belong to another recording: it is used only for images of its size, with a note. Read in this
    order: cam_params.json (with depth units), camera_info.yaml (ROS), camera-intrinsics.txt (a matrix), files of the
    installed readers. Returns None without a camera. Raises DatasetError.
    """
    names = (CAMERA_FILE, *CAMERA_INFO_FILES, INTRINSICS_FILE)
    for path in (folder / name for name in names):
        if path.is_file():
            return read_camera_file(path, width_px, height_px)
    for _, reader in installed(Group.CAMERAS):
        for path in sorted(path for pattern in reader.patterns for path in folder.glob(pattern)):
            if (other := reader.read(path, width_px, height_px)) is not None:
                return cast(FolderCamera, other)
    if published is not None:
        return published
    for path in (folder.absolute().parent / name for name in names):
        if path.is_file():
            found = read_camera_file(path, width_px, height_px)
            if (found.camera.width_px, found.camera.height_px) == (width_px, height_px):
                return replace(found, note=f"the camera is that of {path}, one folder above the images")
    return None


def read_camera_file(path: Path, width_px: int, height_px: int) -> FolderCamera:
    """Return the camera of a file: of an installed reader, or by its name *.json, *.yaml, or a text with a matrix.

    The size is that of the images; only a matrix does not state it. Raises DatasetError.
    """
    is_own = path.name in (CAMERA_FILE, *CAMERA_INFO_FILES, INTRINSICS_FILE)
    for _, reader in () if is_own else installed(Group.CAMERAS):
        if any(map(path.match, reader.patterns)) and (found := reader.read(path, width_px, height_px)) is not None:
            return cast(FolderCamera, found)
    if path.suffix == ".json":
        return read_json_camera(path)
    if path.suffix in (".yaml", ".yml"):
        return read_camera_info(path)
    return FolderCamera(read_matrix(path).camera(str(path), width_px, height_px))


def read_matrix(path: Path) -> FileIntrinsics:
    """Return the intrinsics of a file with a 3x3 matrix K in three rows. Raises DatasetError."""
    rows = read_rows(path)
    if len(rows) != 3:
        raise DatasetError(f"{path}: expected the 3 rows of a camera matrix, got {len(rows)}")
    K = np.array([parse_numbers(location, fields, 3, "a row of a camera matrix") for location, fields in rows])
    zeros = (K[0, 1], K[1, 0], K[2, 0], K[2, 1])
    if any(value != 0.0 for value in zeros) or K[2, 2] != 1.0:
        raise DatasetError(f"{path}: expected rows fx 0 cx, 0 fy cy, 0 0 1, got {K.tolist()}")
    return FileIntrinsics(float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]))


def read_json_camera(path: Path) -> FolderCamera:
    """Return the camera of {"camera": {"w","h","fx","fy","cx","cy","scale"}}, scale: depth units per metre.

    "distortion_model" and "distortion" (a list) may state the lens, "depth_registered" (true or false) whether depth
    belongs to the colour pixels. Raises DatasetError.
    """
    try:
        loaded = json.loads(read_text(path))
        fields = loaded.get("camera", loaded)
        numbers = {name: float(fields[name]) for name in ("w", "h", "fx", "fy", "cx", "cy", "scale")}
        lens = lens_of(str(path), fields.get("distortion_model", "plumb_bob"), fields.get("distortion", ()))
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        expected = '{"camera": {"w", "h", "fx", "fy", "cx", "cy", "scale"}} with decimal points'
        raise DatasetError(f"{path}: expected {expected}; {type(error).__name__}: {error}") from None
    if not (np.isfinite(numbers["scale"]) and numbers["scale"] >= _MIN_UNITS_PER_METRE):
        expected = "depth units per metre, such as 1000 for millimetres"
        raise DatasetError(f"{path}: scale: expected {expected}, got {numbers['scale']:g}")
    if not (np.isfinite(numbers["w"]) and np.isfinite(numbers["h"])):
        raise DatasetError(f"{path}: expected a finite width and height, got {numbers['w']} and {numbers['h']}")
    registered = fields.get("depth_registered")
    if not isinstance(registered, bool | None):
        raise DatasetError(f"{path}: depth_registered: expected true or false, got {registered!r}")
    camera = FileIntrinsics(numbers["fx"], numbers["fy"], numbers["cx"], numbers["cy"]).camera(
        str(path), int(numbers["w"]), int(numbers["h"])
    )
    return FolderCamera(camera, numbers["scale"], lens, depth_registered=registered)


def read_camera_info(path: Path) -> FolderCamera:
    """Return the camera of a ROS camera_info file (YAML). Raises DatasetError."""
    import yaml

    try:
        fields = yaml.safe_load(read_text(path))
        width, height = int(fields["image_width"]), int(fields["image_height"])
        K = [float(value) for value in fields["camera_matrix"]["data"]]
        lens = lens_of(
            str(path), fields.get("distortion_model", "plumb_bob"), fields["distortion_coefficients"]["data"]
        )
        intrinsics = FileIntrinsics(K[0], K[4], K[2], K[5])
    except (yaml.YAMLError, ValueError, KeyError, TypeError, IndexError, AttributeError) as error:
        expected = "image_width, image_height, camera_matrix and distortion_coefficients with data"
        reason = " ".join(str(error).split())[:120]
        raise DatasetError(f"{path}: expected {expected}; {type(error).__name__}: {reason}") from None
    return FolderCamera(intrinsics.camera(str(path), width, height), lens=lens)


def lens_of(location: str, model: str, coefficients: Iterable[float]) -> Lens | None:
    """Return the lens of these coefficients in OpenCV's order; None for a pinhole camera. Raises DatasetError.

    An equidistant lens whose coefficients are all zero is no pinhole camera. OpenCV's thin prism and tilt, after the
    eighth coefficient, must be zero.
    """
    values = tuple(float(value) for value in coefficients)
    name = re.sub(r"[\s_-]", "", str(model).lower())
    lens_model = _LENS_MODELS.get(name)
    if lens_model is not LensModel.FISHEYE and not any(values) and (lens_model or name in _WITHOUT_LENS):
        return None
    if lens_model is None:
        expected = "plumb_bob, rational_polynomial, radtan, equidistant or fisheye"
        raise DatasetError(f"{location}: distortion_model: expected {expected}, got {str(model)[:40]!r}")
    count = _MAX_COEFFICIENTS[lens_model]
    if any(values[count:]):
        raise DatasetError(
            f"{location}: expected a {lens_model} lens of at most {count} coefficients, got {len(values)}; rectify the "
            "images (a ROS bag: with image_proc, and use image_rect_color)"
        )
    try:
        return Lens(lens_model, values[:count])
    except InvalidInputError as error:
        raise DatasetError(f"{location}: {error}") from None
