"""Read 7-Scenes and other sequences of frame-000000.color / .depth / .pose files."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Final

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.datasets.camera_files import CAMERA_FILE, INTRINSICS_FILE, FolderCamera, read_folder_camera
from gausslite.datasets.files import DepthUnits, first_readable_size, parse_numbers, read_rows
from gausslite.datasets.folder import FIRST_VIEW_UP, FolderReader, estimate_up
from gausslite.domain.camera import FileIntrinsics
from gausslite.domain.errors import DatasetError, PoseError
from gausslite.domain.pose import UpAxis, unit_up_axis
from gausslite_recorders.numbered_folder import NumberedFolderSource

_UNITS = DepthUnits(per_metre=1000.0)
_COLOUR_NAME = re.compile(r"frame-(\d{6})\.color\.(?:png|jpg)")
_KINECT = FileIntrinsics(585.0, 585.0, 320.0, 240.0)
_KINECT_SIZE = (640, 480)
_ASSUMED = (
    f"no file states the camera: that of 7-Scenes is assumed (focal length {_KINECT.fx:g} px); {CAMERA_FILE} or "
    f"{INTRINSICS_FILE} in the folder states another"
)
_UP_POSES = 64


class SevenScenesSource(NumberedFolderSource):
    """A folder of frame-%06d.color.{png,jpg}, .depth.{png,pgm} (mm; 0, 65535 invalid) and .pose.txt (camera to world).

    The camera comes from a camera file, see `read_folder_camera`; otherwise 640x480 images get the intrinsics that the
    7-Scenes authors publish. Frames whose pose has no finite
    number, or only zeros, are excluded. Times are the frame numbers at 30 Hz. Raises DatasetError.
    """

    _layout_has_registered_depth = False
    """Colour and depth come from two cameras."""

    def __init__(self, folder: Path, up_axis: UpAxis | None = None, require_poses: bool = True) -> None:
        super().__init__(folder)
        self._find_colours(folder, folder.iterdir(), _COLOUR_NAME, "frame-000000.color.png or .jpg")
        self._select_frames(require_poses)
        size_px = first_readable_size(self._colours[number] for number in self._numbers)
        self._set_camera(_camera(folder, *size_px), _UNITS)
        self._up_axis = unit_up_axis(up_axis) if up_axis else self._estimate_up_axis()

    @staticmethod
    def recognises(folder: Path) -> bool:
        """True if the folder has this layout."""
        return any(folder.glob("frame-??????.*"))

    @property
    def up_axis(self) -> UpAxis:
        """Estimated from the poses, unless the caller gives another: the first camera defines the world frame.

        In RedKitchen it differs by 2.5 degrees from the normal of the table, which is 27 degrees off -y.
        """
        return self._up_axis

    def _depth_path(self, number: int) -> Path:
        path = self._folder / f"frame-{number:06d}.depth.png"
        return path if path.is_file() or not path.with_suffix(".pgm").is_file() else path.with_suffix(".pgm")

    def _pose_location(self, number: int) -> str:
        return str(self._folder / f"frame-{number:06d}.pose.txt")

    def _read_matrix(self, number: int) -> Float64[ndarray, "4 4"]:
        path = Path(self._pose_location(number))
        rows = read_rows(path)
        if len(rows) != 4:
            raise DatasetError(f"{path}: expected the 4 rows of a 4x4 pose, got {len(rows)}")
        return np.array([parse_numbers(location, fields, 4, "a row of a 4x4 pose") for location, fields in rows])

    def _estimate_up_axis(self) -> UpAxis:
        rotations = []
        for number in self._numbers[:: max(1, len(self._numbers) // _UP_POSES)]:
            try:
                rotations.append(self._read_pose(number)[:3, :3])
            except (DatasetError, PoseError):
                # `frame` reports a damaged pose if it is used
                continue
        return estimate_up(np.array(rotations).reshape(-1, 3, 3), FIRST_VIEW_UP)


def _camera(folder: Path, width_px: int, height_px: int) -> FolderCamera:
    """Return the camera of a file in the folder, else the published one."""
    from_file = read_folder_camera(folder, width_px, height_px)
    if from_file is not None:
        return from_file
    if (width_px, height_px) != _KINECT_SIZE:
        raise DatasetError(
            f"{folder}: the camera of {width_px}x{height_px} images is unknown: "
            f"expected the file {INTRINSICS_FILE} or {CAMERA_FILE}"
        )
    return FolderCamera(_KINECT.camera(str(folder), width_px, height_px), note=_ASSUMED)


SEVEN_SCENES: Final = FolderReader(SevenScenesSource, "7-Scenes (frame-000000.color.png ...)")
