"""What layouts of numbered image files have in common."""

from __future__ import annotations

import re
from abc import abstractmethod
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.datasets.files import load_rgbd
from gausslite.datasets.folder import FolderSource, Origin, is_lost
from gausslite.datasets.pose_track import nearest_rigid
from gausslite.datasets.source import excluded_frames_note, require_position
from gausslite.domain.errors import DatasetError, PoseError
from gausslite.domain.frame import MAX_COORDINATE_M, Frame
from gausslite.domain.pose import Trajectory

_RATE_HZ = 30
_ORIGIN_POSES = 9


class NumberedFolderSource(FolderSource):
    """Numbered image files at 30 Hz. Frames without a pose are excluded, or have the identity if none is required."""

    _colours: dict[int, Path]
    _numbers: list[int]
    _require_poses: bool

    def _find_colours(self, folder: Path, paths: Iterable[Path], pattern: re.Pattern[str], expected: str) -> None:
        """Find the colour images by their names. Raises DatasetError if there are none."""
        matches = (pattern.fullmatch(path.name) for path in paths)
        colours = {int(match.group(1)): folder / match.group(0) for match in matches if match}
        require_frames(folder, len(colours), f"images named {expected}")
        self._colours = dict(sorted(colours.items()))

    def _select_frames(self, require_poses: bool) -> None:
        """Exclude the frames without a pose if poses are required. Raises DatasetError if none is left."""
        self._require_poses = require_poses
        self._numbers = [number for number in self._colours if not require_poses or not self._is_lost(number)]
        require_frames(self._folder, len(self._numbers), "frames with a pose")
        some = self._numbers[:: -(-len(self._numbers) // _ORIGIN_POSES)]
        positions_m = [self._read_matrix(number)[:3, 3] for number in some if self._has_pose(number)]
        self._origin = Origin.near(np.array(positions_m).reshape(-1, 3))

    @abstractmethod
    def _depth_path(self, number: int) -> Path:
        """Return the path of a frame's depth image."""

    @abstractmethod
    def _read_matrix(self, number: int) -> Float64[ndarray, "4 4"]:
        """Return a frame's pose as its file states it. Raises DatasetError."""

    @abstractmethod
    def _pose_location(self, number: int) -> str:
        """Return the file, or the file and row, of a frame's pose, for error messages."""

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
        T_world_camera = self._read_pose(number)
        image = load_rgbd(self._colours[number], self._depth_path(number), self.camera, self._units, size)
        return image.frame(number, number * 10**9 // _RATE_HZ, T_world_camera)

    def indices(self) -> Sequence[int]:
        """Return the numbers in the file names."""
        return list(self._numbers)

    def trajectory(self) -> Trajectory:
        """Return the poses at the frames' times."""
        poses = [self._read_pose(number) for number in self._numbers]
        return Trajectory(np.array(self._numbers) / _RATE_HZ, np.array(poses))

    def _is_lost(self, number: int) -> bool:
        try:
            T = self._read_matrix(number)
            return is_lost(T[:3, 3], T[:3, :3])
        except (DatasetError, PoseError):
            return False  # `frame` reports a damaged pose if it is used

    def _read_pose(self, number: int) -> Float64[ndarray, "4 4"]:
        if not self._require_poses and not self._has_pose(number):
            return np.eye(4)
        location = self._pose_location(number)
        T = self._origin.moved(nearest_rigid(location, self._read_matrix(number)))
        if (distance_m := np.abs(T[:3, 3]).max()) > MAX_COORDINATE_M:
            raise PoseError(f"{location}: expected a camera within 10 km of the map's origin, got {distance_m:g} m")
        return T

    def _has_pose(self, number: int) -> bool:
        try:
            T = self._read_matrix(number)
            return not is_lost(T[:3, 3], T[:3, :3])
        except (DatasetError, PoseError):
            return False


def require_frames(folder: Path, count: int, expected: str) -> None:
    """Raise DatasetError if the sequence has no frames."""
    if count == 0:
        raise DatasetError(f"{folder}: expected {expected}, got none")
