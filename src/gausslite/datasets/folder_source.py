"""Bases of the readers of recorded sequences: what all folder layouts have in common."""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.datasets.images import DepthUnits, load_rgbd
from gausslite.datasets.intrinsics import FolderCamera
from gausslite.datasets.poses import is_lost, nearest_rigid
from gausslite.datasets.regions import REGIONS_FILE, balls_for_small_objects, load_voxel_regions
from gausslite.datasets.source import excluded_frames_note, require_frames, require_position
from gausslite.domain.camera import Camera
from gausslite.domain.errors import DatasetError, PoseError
from gausslite.domain.frame import Frame
from gausslite.domain.lens import Lens
from gausslite.domain.pose import UpAxis
from gausslite.domain.region import Region
from gausslite.domain.trajectory import Trajectory

_RATE_HZ = 30


class FolderSource:
    """Name, camera, upward direction and regions of a sequence in a folder."""

    _camera: Camera
    _lens: Lens | None
    _units: DepthUnits
    _up_axis: UpAxis

    def __init__(self, folder: Path) -> None:
        """Subclasses also call `_set_camera` and set `_up_axis`."""
        self._folder = folder

    def _set_camera(self, found: FolderCamera, default_units: DepthUnits) -> None:
        """Use this camera and its depth units, if it states them."""
        self._camera, self._lens = found.camera, found.lens
        self._units = replace(default_units, per_metre=found.units_per_metre or default_units.per_metre)

    @property
    def name(self) -> str:
        """Name of the folder."""
        return self._folder.name

    @property
    def camera(self) -> Camera:
        """Camera at the size of the recorded images."""
        return self._camera

    @property
    def lens(self) -> Lens | None:
        """Lens that is stated for the camera, else None."""
        return self._lens

    @property
    def up_axis(self) -> UpAxis:
        """The layout's upward direction, unless the caller gives another."""
        return self._up_axis

    @property
    def camera_ideal(self) -> bool:
        """False: a recording may have any camera."""
        return False

    @property
    def poses_exact(self) -> bool:
        """False: the files do not state how the poses were found."""
        return False

    @property
    def world_frame(self) -> str:
        """Name of the recording, also where the folder is given as "."."""
        return self.name or self._folder.resolve().name

    @property
    def regions_file(self) -> Path | None:
        """roi_voxels.npz in the folder; None without it."""
        path = self._folder / REGIONS_FILE
        return path if path.is_file() else None

    def regions(self) -> Mapping[str, Region]:
        """Return the regions of roi_voxels.npz in the folder, small objects as balls; empty without the file."""
        path = self.regions_file
        return {} if path is None else balls_for_small_objects(load_voxel_regions(path))


class NumberedFolderSource(FolderSource, ABC):
    """A folder whose image files are numbered, with times at 30 Hz.

    Frames without a pose are excluded if poses are required; otherwise they have the identity.
    """

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
        image = load_rgbd(self._colours[number], self._depth_path(number), self._camera, self._units, size)
        return Frame(
            number,
            number * 10**9 // _RATE_HZ,
            image.rgb,
            image.depth_m,
            image.camera,
            T_world_camera,
            recorded_rgb=image.recorded_rgb,
        )

    def indices(self) -> Sequence[int]:
        """Return the numbers in the file names."""
        return list(self._numbers)

    def trajectory(self) -> Trajectory:
        """Return the poses at the frames' times."""
        poses = [self._read_pose(number) for number in self._numbers]
        return Trajectory(np.array(self._numbers) / _RATE_HZ, np.array(poses))

    def _is_lost(self, number: int) -> bool:
        try:
            return is_lost(self._read_matrix(number)[:3])
        except (DatasetError, PoseError):
            return False  # `frame` reports a damaged pose if it is used

    def _read_pose(self, number: int) -> Float64[ndarray, "4 4"]:
        if not self._require_poses and not self._has_pose(number):
            return np.eye(4)
        return nearest_rigid(self._pose_location(number), self._read_matrix(number))

    def _has_pose(self, number: int) -> bool:
        try:
            return not is_lost(self._read_matrix(number)[:3])
        except (DatasetError, PoseError):
            return False
