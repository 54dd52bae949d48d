"""Read Replica sequences in the layout of NICE-SLAM."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.datasets.images import DepthUnits, load_rgbd
from gausslite.datasets.intrinsics import CAMERA_FILE, find_in_or_above, read_json_camera
from gausslite.datasets.poses import is_lost, nearest_rigid
from gausslite.datasets.regions import regions_in_folder
from gausslite.datasets.source import excluded_frames_note, require_frames, require_position
from gausslite.datasets.text_files import parse_numbers, read_rows
from gausslite.domain.camera import Camera
from gausslite.domain.errors import DatasetError
from gausslite.domain.frame import Frame
from gausslite.domain.lens import Lens
from gausslite.domain.pose import UpAxis, unit_up_axis
from gausslite.domain.region import Region
from gausslite.domain.trajectory import Trajectory

_RATE_HZ = 30
_COLOUR_NAME = re.compile(r"frame(\d{6})\.(?:jpg|png)")


class ReplicaSource:
    """A folder with results/frame%06d.jpg, results/depth%06d.png and traj.txt, one 4x4 row-major pose per row.

    cam_params.json lies in or above the folder. Frames whose pose has no finite number, or only zeros, are excluded.
    Times are the frame numbers at 30 Hz. Raises DatasetError, PoseError.
    """

    def __init__(self, folder: Path, up_axis: UpAxis | None = None) -> None:
        self._folder = folder
        results = folder / "results"
        matches = (_COLOUR_NAME.fullmatch(path.name) for path in (results.iterdir() if results.is_dir() else ()))
        colours = {int(match.group(1)): results / match.group(0) for match in matches if match}
        require_frames(results, len(colours), "images named frame000000.jpg")
        self._colours = dict(sorted(colours.items()))
        camera_path = find_in_or_above(folder, CAMERA_FILE)
        if camera_path is None:
            raise DatasetError(f"{folder}: the camera is unknown: expected {CAMERA_FILE} here or one folder above")
        from_file = read_json_camera(camera_path)
        self._camera, self._lens = from_file.camera, from_file.lens
        self._units = DepthUnits(from_file.units_per_metre or 1.0)
        self._trajectory = folder / "traj.txt"
        self._pose_rows = read_rows(self._trajectory)
        last = max(self._colours)
        if len(self._pose_rows) <= last:
            raise DatasetError(
                f"{self._trajectory}: expected a pose for each of frames 0 to {last}, got {len(self._pose_rows)} rows"
            )
        self._numbers = [number for number in self._colours if not self._is_lost(number)]
        require_frames(folder, len(self._numbers), "frames with a pose")
        self._up_axis = unit_up_axis(up_axis or (0.0, 0.0, 1.0))

    @staticmethod
    def recognises(folder: Path) -> bool:
        """True if the folder has this layout."""
        return (folder / "traj.txt").is_file() or any((folder / "results").glob("frame??????.*"))

    @property
    def name(self) -> str:
        """Name of the folder."""
        return self._folder.name

    @property
    def camera(self) -> Camera:
        """Camera of cam_params.json."""
        return self._camera

    @property
    def lens(self) -> Lens | None:
        """Lens of cam_params.json, else None."""
        return self._lens

    @property
    def up_axis(self) -> UpAxis:
        """The z axis, unless the caller gives another."""
        return self._up_axis

    @property
    def depth_registered(self) -> bool:
        """True: one camera renders both images."""
        return True

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
        depth = self._folder / "results" / f"depth{number:06d}.png"
        image = load_rgbd(self._colours[number], depth, self._camera, self._units, size)
        return Frame(number, number * 10**9 // _RATE_HZ, image.rgb, image.depth_m, image.camera, T_world_camera)

    def indices(self) -> Sequence[int]:
        """Return the numbers in the file names."""
        return list(self._numbers)

    def trajectory(self) -> Trajectory:
        """Return the poses at the frames' times."""
        poses = [self._read_pose(number) for number in self._numbers]
        return Trajectory(np.array(self._numbers) / _RATE_HZ, np.array(poses))

    def regions(self) -> Mapping[str, Region]:
        """Return the regions of roi_voxels.npz in the folder, small objects as balls; empty without the file."""
        return regions_in_folder(self._folder)

    def _is_lost(self, number: int) -> bool:
        try:
            return is_lost(self._read_matrix(number)[:3])
        except DatasetError:
            return False  # `frame` reports a damaged row if it is used

    def _read_pose(self, number: int) -> Float64[ndarray, "4 4"]:
        return nearest_rigid(self._pose_rows[number][0], self._read_matrix(number))

    def _read_matrix(self, number: int) -> Float64[ndarray, "4 4"]:
        place, fields = self._pose_rows[number]
        return np.array(parse_numbers(place, fields, 16, "a 4x4 pose, row by row")).reshape(4, 4)
