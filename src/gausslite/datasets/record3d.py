"""Read recordings of the app Record3D (iPhone and iPad): an .r3d file, or the folder that it unzips to."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float32, Float64
from numpy import ndarray

from gausslite.datasets.folder_source import FolderSource
from gausslite.datasets.images import DepthUnits, RgbdImage, decode_image, resize_depth, resize_rgbd
from gausslite.datasets.intrinsics import FolderCamera
from gausslite.datasets.poses import estimate_up, is_lost, pose_from_quaternion
from gausslite.datasets.record3d_files import METADATA, Record3dFiles
from gausslite.datasets.record3d_metadata import Record3dMetadata
from gausslite.datasets.source import excluded_frames_note, require_frames, require_position
from gausslite.domain.errors import DatasetError
from gausslite.domain.frame import Frame
from gausslite.domain.pose import UpAxis, unit_up_axis
from gausslite.domain.trajectory import Trajectory

_FILE_ENDING = ".r3d"
_OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
_FIRST_VIEW_UP = (0.0, 1.0, 0.0)
_LOW_CONFIDENCE = 0


class Record3dSource(FolderSource):
    """Frames rgbd/N.jpg with rgbd/N.depth: float32 in metres, compressed with LZFSE, aligned to colour.

    Depth images are smaller than colour; each colour pixel gets the nearest depth pixel. Pixels whose confidence in
    rgbd/N.conf is low (0) have no depth. Images without depth or pose are excluded. The world is the first camera's.
    Sources of the layout: `record3d_metadata` and `record3d_files`. Raises DatasetError, PoseError.
    """

    def __init__(self, path: Path, up_axis: UpAxis | None = None, require_poses: bool = True) -> None:
        super().__init__(path)
        self._files = Record3dFiles(path)
        self._metadata_path = self._files.path_of(METADATA)
        self._metadata = Record3dMetadata.parse(self._metadata_path, self._files.read(METADATA))
        self._require_poses = require_poses
        recorded = self._files.colour_numbers()
        self._recorded = len(recorded)
        self._numbers = [n for n in recorded if self._files.has(f"rgbd/{n}.depth") and self._may_use(n)]
        require_frames(path, len(self._numbers), "rgbd/0.jpg ... with .depth files and poses in metadata")
        self._set_camera(FolderCamera(self._metadata.camera), DepthUnits(1.0))
        rotations = np.array([self._read_pose(n)[:3, :3] for n in self._numbers])
        self._up_axis = unit_up_axis(up_axis or estimate_up(rotations, _FIRST_VIEW_UP))

    @staticmethod
    def recognises(path: Path) -> bool:
        """True for an .r3d file, and for a folder with the files of one."""
        if path.is_dir():
            return (path / METADATA).is_file() and (path / "rgbd").is_dir()
        return path.suffix.lower() == _FILE_ENDING and path.is_file()

    @property
    def name(self) -> str:
        """Name of the file or folder without its ending."""
        return self._folder.name.removesuffix(_FILE_ENDING)

    @property
    def depth_registered(self) -> bool:
        """True: the app aligns depth to colour."""
        return True

    @property
    def excluded_frames(self) -> str:
        """Message on the colour images without depth or pose."""
        return excluded_frames_note(self._recorded - len(self), self._recorded, "without depth or pose")

    def __len__(self) -> int:
        return len(self._numbers)

    def frame(self, i: int, size: tuple[int, int] | None = None) -> Frame:
        """Return the frame at position i. Raises DatasetError, PoseError."""
        require_position(self.name, i, len(self))
        number = self._numbers[i]
        name = f"rgbd/{number}.jpg"
        bgr = decode_image(self._files.path_of(name), self._files.read(name), ".jpg", cv2.IMREAD_COLOR)
        camera = self._metadata.camera_at(f"{self._metadata_path}: perFrameIntrinsicCoeffs {number}", number)
        if bgr.shape[:2] != (camera.height_px, camera.width_px):
            expected = f"{camera.width_px}x{camera.height_px}"
            got = f"{bgr.shape[1]}x{bgr.shape[0]}"
            raise DatasetError(f"{self._files.path_of(name)}: expected the size in metadata, {expected}, got {got}")
        depth_m = resize_depth(self._read_depth(number), (camera.width_px, camera.height_px))
        image = resize_rgbd(RgbdImage(np.ascontiguousarray(bgr[..., ::-1]), depth_m, camera), size)
        time_ns = self._metadata.time_ns(number)
        return Frame(
            number,
            time_ns,
            image.rgb,
            image.depth_m,
            image.camera,
            self._read_pose(number),
            recorded_rgb=image.recorded_rgb,
        )

    def indices(self) -> Sequence[int]:
        """Return the numbers in the file names."""
        return list(self._numbers)

    def trajectory(self) -> Trajectory:
        """Return the poses at the frames' times."""
        times_ns = np.array([self._metadata.time_ns(number) for number in self._numbers])
        return Trajectory(times_ns / 1e9, np.array([self._read_pose(number) for number in self._numbers]))

    def _may_use(self, number: int) -> bool:
        return not self._require_poses or self._has_pose(number)

    def _has_pose(self, number: int) -> bool:
        return number < len(self._metadata.poses) and not is_lost(self._metadata.poses[number])

    def _read_pose(self, number: int) -> Float64[ndarray, "4 4"]:
        if not self._has_pose(number):
            return np.eye(4)
        row = self._metadata.poses[number]
        return pose_from_quaternion(f"{self._metadata_path}: poses {number}", row[4:], row[:4]) @ _OPENGL_TO_OPENCV

    def _read_depth(self, number: int) -> Float32[ndarray, "h w"]:
        """Return the recorded depth image, 0 where invalid or of low confidence. Raises DatasetError."""
        width, height = self._depth_size()
        name, confidence_name = f"rgbd/{number}.depth", f"rgbd/{number}.conf"
        depth_m = self._files.read_array(name, np.float32, width * height)
        depth_m[~(np.isfinite(depth_m) & (depth_m > 0))] = 0.0
        # recordings of the front camera have no confidence
        if self._files.has(confidence_name) and self._files.read(confidence_name):
            depth_m[self._files.read_array(confidence_name, np.uint8, width * height) == _LOW_CONFIDENCE] = 0.0
        return depth_m.reshape(height, width)

    def _depth_size(self) -> tuple[int, int]:
        if self._metadata.depth_size is None:
            raise DatasetError(f"{self._metadata_path}: expected the size of the depth images, dw and dh, got none")
        return self._metadata.depth_size
