"""Read images that the ZED SDK exports from an SVO recording, with a file of poses beside them."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Final

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.datasets.camera_files import example_camera_file, read_folder_camera
from gausslite.datasets.files import DepthUnits, first_readable_size, parse_numbers, read_rows
from gausslite.datasets.folder import FIRST_VIEW_UP, FolderReader, is_lost
from gausslite.datasets.pose_track import pose_from_quaternion
from gausslite.domain.errors import DatasetError
from gausslite.domain.pose import UpAxis, unit_up_axis
from gausslite_recorders.numbered_folder import NumberedFolderSource

_MILLIMETRES = DepthUnits(per_metre=1000.0)
_COLOUR_NAME = re.compile(r"left(\d{6})\.png")
_POSE_FILES = ("poses.csv", "poses.txt")
_MEANING = "frame tx ty tz qx qy qz qw"


class ZedSource(NumberedFolderSource):
    """A folder of left%06d.png with depth%06d.png (16 bit) or depth%06d.npy (float32), both in millimetres.

    The names and the unit are those of the sample "SVO Export", mode 4, in github.com/stereolabs/zed-sdk
    (recording/export/svo). The sample writes neither poses nor intrinsics: poses.csv or poses.txt has rows of
    frame, tx, ty, tz, qx, qy, qz, qw with the SDK's coordinate system IMAGE (x right, y down, z forward) in metres. The
    camera comes from a camera file such as cam_params.json, whose scale may state another unit of depth. The left image
    is rectified, and depth belongs to it. Frames without a pose are excluded. Raises DatasetError, PoseError.
    """

    _layout_has_registered_depth = True
    """The SDK computes depth for the left image."""

    def __init__(self, folder: Path, up_axis: UpAxis | None = None, require_poses: bool = True) -> None:
        super().__init__(folder)
        self._find_colours(folder, folder.iterdir(), _COLOUR_NAME, "left000000.png")
        self._pose_rows = _read_pose_rows(folder, require_poses)
        self._select_frames(require_poses)
        size_px = first_readable_size(self._colours[number] for number in self._numbers)
        found = read_folder_camera(folder, *size_px)
        if found is None:
            raise DatasetError(
                f"{folder}: the camera is unknown: expected {example_camera_file(*size_px)} with the SDK's "
                "calibration_parameters.left_cam (the file SN*.conf has those of the unrectified images)"
            )
        self._set_camera(found, _MILLIMETRES)
        self._up_axis = unit_up_axis(up_axis or FIRST_VIEW_UP)

    @staticmethod
    def recognises(folder: Path) -> bool:
        """True if the folder has this layout."""
        return any(folder.glob("left??????.png"))

    @property
    def up_axis(self) -> UpAxis:
        """-y, unless the caller gives another: the SDK's tracking aligns its world with gravity."""
        return self._up_axis

    def _depth_path(self, number: int) -> Path:
        exact = self._folder / f"depth{number:06d}.npy"
        return exact if exact.is_file() else exact.with_suffix(".png")

    def _pose_location(self, number: int) -> str:
        return self._pose_rows[number][0] if number in self._pose_rows else str(self._folder / _POSE_FILES[0])

    def _read_matrix(self, number: int) -> Float64[ndarray, "4 4"]:
        if number not in self._pose_rows:
            return np.full((4, 4), np.nan)
        location, row = self._pose_rows[number]
        if is_lost(row[:3], row[3:]):
            return np.full((4, 4), np.nan)
        return pose_from_quaternion(location, row[:3], row[3:])


def _read_pose_rows(folder: Path, required: bool) -> Mapping[int, tuple[str, Float64[ndarray, "7"]]]:
    """Return location and numbers of each frame's row; none without a file if poses are not required."""
    path = next((folder / name for name in _POSE_FILES if (folder / name).is_file()), None)
    if path is None:
        if required:
            raise DatasetError(
                f"{folder}: expected {' or '.join(_POSE_FILES)} with rows of {_MEANING}, got none; "
                "map with --poses track to find poses from the images"
            )
        return {}
    rows = {}
    for location, fields in read_rows(path):
        numbers = parse_numbers(location, fields, 8, _MEANING)
        if not 0 <= numbers[0] <= 999_999 or numbers[0] != int(numbers[0]):
            raise DatasetError(f"{location}: expected a frame's number, such as 12 for left000012.png, got {fields[0]}")
        rows[int(numbers[0])] = location, np.array(numbers[1:])
    return rows


ZED: Final = FolderReader(ZedSource, "ZED (left000000.png, depth000000.png)")
"""The reader of the group `gausslite.sources`."""
