"""Read 7-Scenes and other sequences of frame-000000.color / .depth / .pose files."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.datasets.images import DepthUnits, first_readable_size, load_rgbd
from gausslite.datasets.intrinsics import CAMERA_FILE, INTRINSICS_FILE, FileIntrinsics, FolderCamera, read_folder_camera
from gausslite.datasets.poses import estimate_up, is_lost, nearest_rigid
from gausslite.datasets.regions import regions_in_folder
from gausslite.datasets.source import excluded_frames_note, require_frames, require_position
from gausslite.datasets.text_files import parse_numbers, read_rows
from gausslite.domain.camera import Camera
from gausslite.domain.errors import DatasetError, PoseError
from gausslite.domain.frame import Frame
from gausslite.domain.lens import Lens
from gausslite.domain.pose import UpAxis, unit_up_axis
from gausslite.domain.region import Region
from gausslite.domain.trajectory import Trajectory

_UNITS = DepthUnits(per_metre=1000.0, invalid=(0, 65535))
_RATE_HZ = 30
_COLOUR_NAME = re.compile(r"frame-(\d{6})\.color\.(?:png|jpg)")
_KINECT = FileIntrinsics(585.0, 585.0, 320.0, 240.0)
_KINECT_SIZE = (640, 480)
_UP_POSES = 64
_LEVEL_FIRST_VIEW_UP = (0.0, -1.0, 0.0)


class SevenScenesSource:
    """A folder of frame-%06d.color.{png,jpg}, .depth.png (mm; 0 and 65535 invalid) and .pose.txt (camera to world).

    The camera comes from cam_params.json (with the depth units) or camera-intrinsics.txt in or above the folder;
    otherwise 640x480 images get the intrinsics that the 7-Scenes authors publish. Frames whose pose has no finite
    number, or only zeros, are excluded. Times are the frame numbers at 30 Hz. Raises DatasetError.
    """

    def __init__(self, folder: Path, up_axis: UpAxis | None = None) -> None:
        self._folder = folder
        matches = (_COLOUR_NAME.fullmatch(path.name) for path in folder.iterdir())
        colours = {int(match.group(1)): folder / match.group(0) for match in matches if match}
        require_frames(folder, len(colours), "images named frame-000000.color.png or .jpg")
        self._colours = dict(sorted(colours.items()))
        self._numbers = [number for number in self._colours if not self._is_lost(number)]
        require_frames(folder, len(self._numbers), "frames with a pose")
        from_folder = _camera(folder, *first_readable_size(self._colours[number] for number in self._numbers))
        self._camera, self._lens = from_folder.camera, from_folder.lens
        self._units = replace(_UNITS, per_metre=from_folder.units_per_metre or _UNITS.per_metre)
        self._up_axis = unit_up_axis(up_axis) if up_axis else self._estimate_up_axis()

    @staticmethod
    def recognises(folder: Path) -> bool:
        """True if the folder has this layout."""
        return any(folder.glob("frame-??????.*"))

    @property
    def name(self) -> str:
        """Name of the folder."""
        return self._folder.name

    @property
    def camera(self) -> Camera:
        """Camera at the size of the first readable colour image."""
        return self._camera

    @property
    def lens(self) -> Lens | None:
        """Lens of a camera file, else None."""
        return self._lens

    @property
    def up_axis(self) -> UpAxis:
        """Estimated from the poses, unless the caller gives another: the first camera defines the world frame.

        In RedKitchen it differs by 2.5 degrees from the normal of the table, which is 27 degrees off -y.
        """
        return self._up_axis

    @property
    def depth_registered(self) -> bool:
        """False: colour and depth come from two cameras."""
        return False

    @property
    def excluded_frames(self) -> str:
        """Message on the frames without a pose."""
        return excluded_frames_note(len(self._colours) - len(self._numbers), len(self._colours), "without a pose")

    def __len__(self) -> int:
        return len(self._numbers)

    def frame(self, i: int, size: tuple[int, int] | None = None) -> Frame:
        """Return the frame at position i. Raises DatasetError, PoseError."""
        require_position(self.name, i, len(self))
        number = self._numbers[i]
        T_world_camera = _read_pose(self._pose_path(number))
        depth = self._folder / f"frame-{number:06d}.depth.png"
        image = load_rgbd(self._colours[number], depth, self._camera, self._units, size)
        return Frame(number, number * 10**9 // _RATE_HZ, image.rgb, image.depth_m, image.camera, T_world_camera)

    def indices(self) -> Sequence[int]:
        """Return the numbers in the file names."""
        return list(self._numbers)

    def trajectory(self) -> Trajectory:
        """Return the poses at the frames' times."""
        poses = [_read_pose(self._pose_path(number)) for number in self._numbers]
        return Trajectory(np.array(self._numbers) / _RATE_HZ, np.array(poses))

    def regions(self) -> Mapping[str, Region]:
        """Return the regions of roi_voxels.npz in the folder, small objects as balls; empty without the file."""
        return regions_in_folder(self._folder)

    def _pose_path(self, number: int) -> Path:
        return self._folder / f"frame-{number:06d}.pose.txt"

    def _is_lost(self, number: int) -> bool:
        try:
            return is_lost(_read_matrix(self._pose_path(number))[:3])
        except DatasetError:
            return False  # `frame` reports a damaged file if it is used

    def _estimate_up_axis(self) -> UpAxis:
        rotations = []
        for number in self._numbers[:: max(1, len(self._numbers) // _UP_POSES)]:
            try:
                rotations.append(_read_pose(self._pose_path(number))[:3, :3])
            except (DatasetError, PoseError):
                # `frame` reports a damaged pose if it is used
                continue
        return estimate_up(np.array(rotations).reshape(-1, 3, 3), _LEVEL_FIRST_VIEW_UP)


def _read_pose(path: Path) -> Float64[ndarray, "4 4"]:
    return nearest_rigid(str(path), _read_matrix(path))


def _read_matrix(path: Path) -> Float64[ndarray, "4 4"]:
    rows = read_rows(path)
    if len(rows) != 4:
        raise DatasetError(f"{path}: expected the 4 rows of a 4x4 pose, got {len(rows)}")
    return np.array([parse_numbers(place, fields, 4, "a row of a 4x4 pose") for place, fields in rows])


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
    return FolderCamera(_KINECT.camera(str(folder), width_px, height_px))
