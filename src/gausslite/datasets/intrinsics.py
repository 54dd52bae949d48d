"""Camera files of data sets. Their pixel centres lie at integers; GaussLite's lie at +0.5."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gausslite.datasets.text_files import parse_numbers, read_rows, read_text
from gausslite.domain.camera import Camera
from gausslite.errors import DatasetError, InvalidInputError

INTRINSICS_FILE = "camera-intrinsics.txt"
CAMERA_FILE = "cam_params.json"


@dataclass(frozen=True, slots=True)
class FileIntrinsics:
    """Focal lengths and principal point in pixels, in the data set's convention (pixel centres at integers)."""

    fx: float
    fy: float
    cx: float
    cy: float

    def camera(self, place: str, width_px: int, height_px: int) -> Camera:
        """Return the Camera, with 0.5 px added to the principal point. Raises DatasetError with the place."""
        try:
            return Camera(self.fx, self.fy, self.cx + 0.5, self.cy + 0.5, width_px, height_px)
        except InvalidInputError as error:
            raise DatasetError(f"{place}: {error}") from None


def find_in_or_above(folder: Path, name: str) -> Path | None:
    """Return the file of this name in the folder or in its parent, or None."""
    return next((path for path in (folder / name, folder.parent / name) if path.is_file()), None)


def read_folder_camera(folder: Path, width_px: int, height_px: int) -> tuple[Camera, float | None] | None:
    """Return the camera and depth units per metre of a camera file in or above the folder; None without such a file.

    cam_params.json has both; camera-intrinsics.txt has the camera only. Raises DatasetError.
    """
    camera_path, matrix_path = (find_in_or_above(folder, name) for name in (CAMERA_FILE, INTRINSICS_FILE))
    if camera_path is not None:
        return read_json_camera(camera_path)
    if matrix_path is not None:
        return read_matrix(matrix_path).camera(str(matrix_path), width_px, height_px), None
    return None


def read_matrix(path: Path) -> FileIntrinsics:
    """Return the intrinsics of a file with a 3x3 matrix K in three rows. Raises DatasetError."""
    rows = read_rows(path)
    if len(rows) != 3:
        raise DatasetError(f"{path}: expected the 3 rows of a camera matrix, got {len(rows)}")
    K = np.array([parse_numbers(place, fields, 3, "a row of a camera matrix") for place, fields in rows])
    zeros = (K[0, 1], K[1, 0], K[2, 0], K[2, 1])
    if any(value != 0.0 for value in zeros) or K[2, 2] != 1.0:
        raise DatasetError(f"{path}: expected rows fx 0 cx, 0 fy cy, 0 0 1, got {K.tolist()}")
    return FileIntrinsics(float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]))


def read_json_camera(path: Path) -> tuple[Camera, float]:
    """Return camera and depth units per metre of {"camera": {"w","h","fx","fy","cx","cy","scale"}}.

    Raises DatasetError.
    """
    try:
        fields = json.loads(read_text(path))["camera"]
        numbers = {name: float(fields[name]) for name in ("w", "h", "fx", "fy", "cx", "cy", "scale")}
    except (ValueError, KeyError, TypeError) as error:
        expected = '{"camera": {"w", "h", "fx", "fy", "cx", "cy", "scale"}} with numbers'
        raise DatasetError(f"{path}: expected {expected}; {type(error).__name__}: {error}") from None
    if not (np.isfinite(numbers["scale"]) and numbers["scale"] > 0):
        raise DatasetError(f"{path}: expected a positive depth scale, got {numbers['scale']}")
    if not (np.isfinite(numbers["w"]) and np.isfinite(numbers["h"])):
        raise DatasetError(f"{path}: expected a finite width and height, got {numbers['w']} and {numbers['h']}")
    intrinsics = FileIntrinsics(numbers["fx"], numbers["fy"], numbers["cx"], numbers["cy"])
    return intrinsics.camera(str(path), int(numbers["w"]), int(numbers["h"])), numbers["scale"]
