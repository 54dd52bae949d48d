"""Read Replica sequences in the layout of NICE-SLAM."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Final

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.datasets.camera_files import CAMERA_FILE, find_in_or_above, read_json_camera
from gausslite.datasets.files import DepthUnits, parse_numbers, read_rows
from gausslite.datasets.folder import FIRST_VIEW_UP, FolderReader
from gausslite.domain.errors import DatasetError
from gausslite.domain.pose import UpAxis, unit_up_axis
from gausslite_recorders.numbered_folder import NumberedFolderSource

_COLOUR_NAME = re.compile(r"frame(\d{6})\.(?:jpg|png)")


class ReplicaSource(NumberedFolderSource):
    """A folder with results/frame%06d.jpg, results/depth%06d.png and traj.txt, one 4x4 row-major pose per row.

    cam_params.json lies in or above the folder. Frames whose pose has no finite number, or only zeros, are excluded.
    Times are the frame numbers at 30 Hz. Raises DatasetError, PoseError.
    """

    _layout_has_registered_depth = True
    """One camera renders both images."""

    def __init__(self, folder: Path, up_axis: UpAxis | None = None, require_poses: bool = True) -> None:
        super().__init__(folder)
        self._results = folder / "results"
        paths = self._results.iterdir() if self._results.is_dir() else ()
        self._find_colours(self._results, paths, _COLOUR_NAME, "frame000000.jpg")
        camera_path = find_in_or_above(folder, CAMERA_FILE)
        if camera_path is None:
            raise DatasetError(f"{folder}: the camera is unknown: expected {CAMERA_FILE} here or one folder above")
        self._set_camera(read_json_camera(camera_path), DepthUnits(1.0))
        trajectory = folder / "traj.txt"
        self._pose_rows = read_rows(trajectory) if require_poses or trajectory.is_file() else []
        last = max(self._colours)
        if require_poses and len(self._pose_rows) <= last:
            raise DatasetError(
                f"{trajectory}: expected a pose for each of frames 0 to {last}, got {len(self._pose_rows)} rows"
            )
        self._select_frames(require_poses)
        self._up_axis = unit_up_axis(up_axis or ((0.0, 0.0, 1.0) if self._pose_rows else FIRST_VIEW_UP))

    @staticmethod
    def recognises(folder: Path) -> bool:
        """True if the folder has this layout."""
        return (folder / "traj.txt").is_file() or any((folder / "results").glob("frame??????.*"))

    def _depth_path(self, number: int) -> Path:
        return self._results / f"depth{number:06d}.png"

    def _pose_location(self, number: int) -> str:
        return self._pose_rows[number][0]

    def _read_matrix(self, number: int) -> Float64[ndarray, "4 4"]:
        if number >= len(self._pose_rows):
            raise DatasetError(f"{self._folder}: expected a pose of frame {number} in traj.txt, got none")
        location, fields = self._pose_rows[number]
        return np.array(parse_numbers(location, fields, 16, "a 4x4 pose, row by row")).reshape(4, 4)


REPLICA: Final = FolderReader(ReplicaSource, "Replica (results/frame000000.jpg, traj.txt)")
