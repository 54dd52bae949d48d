"""Read TUM RGB-D sequences: associate colour, depth and pose by their timestamps."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.datasets.camera_files import FolderCamera, example_camera_file, read_folder_camera
from gausslite.datasets.files import (
    DepthUnits,
    first_readable_size,
    is_number,
    load_rgbd,
    parse_numbers,
    read_lines,
    read_rows,
    require_points,
)
from gausslite.datasets.folder import FIRST_VIEW_UP, FolderSource, Origin, is_lost
from gausslite.datasets.pose_track import MAX_POSE_GAP_S, PoseTrack, pose_from_quaternion
from gausslite.datasets.source import (
    excluded_frames_note,
    repeated_times_note,
    require_matches,
    require_position,
)
from gausslite.domain.camera import FileIntrinsics
from gausslite.domain.errors import DatasetError
from gausslite.domain.frame import Frame
from gausslite.domain.lens import Lens, LensModel
from gausslite.domain.pose import Trajectory, UpAxis, unit_up_axis

_UNITS = DepthUnits(per_metre=5000.0)
_POSES = "groundtruth.txt"
_LISTS = ("rgb.txt", "depth.txt", _POSES)
_SEPARATOR = re.compile(r"[\s,;\"']+")
"""Separates a time from the rest of its row."""
_MAX_DEPTH_LAG_S, _ROUNDING_S = 0.020, 1e-6
_MAX_TIME_S = 9e9
"""Larger times, of the year 2255, do not fit into 64 bits as nanoseconds."""
_MAX_POSE_LAG_S = 0.010
_PUBLISHED_SIZE_PX = (640, 480)
_SERIES = re.compile(r"(?<![a-z])(?:freiburg|fr)([123])(?!\d)")
_INTRINSICS = {
    "1": FileIntrinsics(517.3, 516.5, 318.6, 255.3),
    "2": FileIntrinsics(520.9, 521.0, 325.1, 249.7),
    "3": FileIntrinsics(535.4, 539.2, 320.1, 247.6),
}

_LENSES = {
    "1": Lens(LensModel.RADTAN, (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    "2": Lens(LensModel.RADTAN, (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
}
"""Published distortion of the colour cameras; the images of fr3 are undistorted."""


@dataclass(frozen=True, slots=True, eq=False)
class _Match:
    number: int
    time_s: float
    colour: Path
    depth: Path
    T_world_camera: Float64[ndarray, "4 4"]


class TumSource(FolderSource):
    """A folder with rgb.txt, depth.txt and groundtruth.txt.

    A colour image is associated with the nearest depth image within 20 ms. Its pose is interpolated (lerp and slerp)
    between two poses at most 1 s apart; if there are none, a pose within 10 ms is used. Colour images without depth
    or pose are excluded, and those with the time of the one before. Poses without a finite number or with a quaternion
    of zeros count as missing. Frame numbers are the rows of rgb.txt from 0. Raises DatasetError, PoseError.
    """

    _layout_has_registered_depth = True
    """The layout has registered depth."""

    def __init__(self, folder: Path, up_axis: UpAxis | None = None, require_poses: bool = True) -> None:
        super().__init__(folder)
        matches, self._recorded, self._repeated = _associate(folder, require_poses)
        self._origin = Origin.near(np.array([match.T_world_camera[:3, 3] for match in matches]))
        moved = self._origin.moved
        self._matches = [replace(match, T_world_camera=moved(match.T_world_camera)) for match in matches]
        size_px = first_readable_size(match.colour for match in self._matches)
        self._set_camera(read_tum_camera(folder, *size_px), _UNITS)
        has_poses = require_poses or (folder / _POSES).is_file()
        self._up_axis = unit_up_axis(up_axis or ((0.0, 0.0, 1.0) if has_poses else FIRST_VIEW_UP))

    @staticmethod
    def recognises(folder: Path) -> bool:
        """True if the folder has this layout."""
        return (folder / "rgb.txt").is_file() or (folder / "groundtruth.txt").is_file()

    @property
    def excluded_frames(self) -> str:
        """Message on the colour images that repeat a time, or without depth or pose at their time."""
        reason = "without poses around them at most 1 s apart, or depth within 20 ms"
        unmatched = excluded_frames_note(self._recorded - self._repeated - len(self), self._recorded, reason)
        return "; ".join(filter(None, (repeated_times_note(self._repeated, self._recorded), unmatched)))

    def __len__(self) -> int:
        return len(self._matches)

    def frame(self, i: int, size: tuple[int, int] | None = None) -> Frame:
        """Return the frame at position i. Raises DatasetError."""
        require_position(self.name, i, len(self))
        match = self._matches[i]
        image = load_rgbd(match.colour, match.depth, self.camera, self._units, size)
        return image.frame(match.number, round(match.time_s * 1e9), match.T_world_camera)

    def indices(self) -> Sequence[int]:
        """Return the rows of rgb.txt, from 0."""
        return [match.number for match in self._matches]

    def trajectory(self) -> Trajectory:
        """Return the interpolated pose of every colour image."""
        poses = np.array([match.T_world_camera for match in self._matches])
        return Trajectory(np.array([match.time_s for match in self._matches]), poses)


def _associate(folder: Path, require_poses: bool) -> tuple[list[_Match], int, int]:
    """Return the colour images with depth and a pose, the number of all colour images, and of repeated times.

    Images without a pose get the identity if poses are not required. Of images with the same time, the first counts:
    depth and pose of the others are unknown.
    """
    colour_times, colour_names = _read_stamps(folder / "rgb.txt")
    depth_times, depth_names = _read_stamps(folder / "depth.txt")
    poses = folder / _POSES
    trajectory = _read_poses(poses, require_poses) if require_poses or poses.is_file() else None
    matches = []
    is_new = np.append(True, np.diff(colour_times) > 0)
    for number in np.flatnonzero(is_new).tolist():
        time_s, name = float(colour_times[number]), colour_names[number]
        nearest = int(np.abs(depth_times - time_s).argmin())
        T_world_camera = None if trajectory is None else trajectory.at(time_s)
        if T_world_camera is None and not require_poses:
            T_world_camera = np.eye(4)
        if abs(depth_times[nearest] - time_s) <= _MAX_DEPTH_LAG_S + _ROUNDING_S and T_world_camera is not None:
            depth = folder / depth_names[nearest]
            matches.append(_Match(number, time_s, folder / name, depth, T_world_camera))
    expected = "a colour image with depth within 20 ms (rgb.txt, depth.txt) and poses around it (groundtruth.txt)"
    times_s = {"colour": colour_times.tolist(), "depth": depth_times.tolist()}
    times_s |= {} if trajectory is None else {"poses": trajectory.times_s.tolist()}
    require_matches(folder, len(matches), expected, times_s)
    return matches, len(colour_names), int(np.count_nonzero(~is_new))


def _read_stamps(path: Path) -> tuple[Float64[ndarray, " n"], list[str]]:
    """Return ascending times in seconds and the image path of each; a header of words is left out."""
    if not path.is_file():
        others = sorted(file.name for file in path.parent.glob("*.txt*") if file.name not in _LISTS)
        found = f"; the folder has {', '.join(others[:8])}: name the list of images {path.name}" if others else ""
        raise DatasetError(f"{path}: expected a text file, got none{found}")
    times, names = [], []
    lines = read_lines(path)
    require_points(lines)
    rows = [(location, _SEPARATOR.split(text.strip("\"'"), maxsplit=1)) for location, text in lines]
    for location, fields in rows[1:] if rows and not is_number(rows[0][1][0]) else rows:
        name = _file_name(path.parent, fields[-1])
        if len(fields) != 2 or name is None:
            raise DatasetError(f"{location}: expected a time and a file name, got {' '.join(fields)[:60]!r}")
        times += parse_numbers(location, fields[:1], 1, "a time in seconds")
        names.append(name)
        if not np.isfinite(times[-1]) or (len(times) > 1 and times[-1] < times[-2]):
            raise DatasetError(f"{location}: expected finite times in ascending order, got {fields[0]}")
        if abs(times[-1]) > _MAX_TIME_S:
            raise DatasetError(f"{location}: expected a time in seconds, got {fields[0]}; are these nanoseconds?")
    if not times:
        raise DatasetError(f"{path}: expected rows of a time and a file name, got none")
    return np.array(times), names


def _file_name(folder: Path, text: str) -> str | None:
    """Return a file's name without quotes or with Windows' separators; None for further fields after it.

    A name with blanks must exist, because it may be several fields.
    """
    name = text.strip(" \t\"',;")
    if "\\" in name and not (folder / name).is_file():
        name = name.replace("\\", "/")
    return name if name and (len(name.split()) == 1 or (folder / name).is_file()) else None


def _read_poses(path: Path, required: bool) -> PoseTrack | None:
    """Return the poses, None for fewer than two that are not required. Raises DatasetError, PoseError."""
    rows = read_rows(path)
    meaning = "time tx ty tz qx qy qz qw"
    table = np.array([parse_numbers(location, fields, 8, meaning) for location, fields in rows])
    known = np.array([not is_lost(row[1:4], row[4:]) for row in table], np.bool_)
    if np.count_nonzero(known) < 2:
        if not required:
            return None
        lost = f" and {len(rows) - np.count_nonzero(known)} rows of NaN, infinity or zeros" if rows else ""
        raise DatasetError(f"{path}: expected at least 2 poses, got {np.count_nonzero(known)}{lost}")
    for i in np.flatnonzero(known):
        pose_from_quaternion(rows[i][0], table[i, 1:4], table[i, 4:8])
    if not (np.isfinite(table[:, 0]).all() and (np.diff(table[:, 0]) >= 0).all()):
        raise DatasetError(f"{path}: expected finite times in ascending order")
    times_s, translations_m, quats_xyzw = table[known, 0], table[known, 1:4], table[known, 4:8]
    lost_s = table[~known, 0]
    return PoseTrack(str(path), times_s, translations_m, quats_xyzw, MAX_POSE_GAP_S, _MAX_POSE_LAG_S, lost_s=lost_s)


def read_tum_camera(folder: Path, width_px: int, height_px: int) -> FolderCamera:
    """Return the camera of a file in the folder, else the published one of fr1, fr2 or fr3 by the folder's name.

    A link's own name counts, and that of its target. The published camera is scaled to images of its aspect ratio.
    Raises DatasetError.
    """
    group = _SERIES.search(f"{folder.absolute().name} {folder.resolve().name}")
    published = None
    if group is not None and width_px * _PUBLISHED_SIZE_PX[1] == height_px * _PUBLISHED_SIZE_PX[0]:
        camera = _INTRINSICS[group.group(1)].camera(str(folder), *_PUBLISHED_SIZE_PX).resized(width_px, height_px)
        is_scaled = (width_px, height_px) != _PUBLISHED_SIZE_PX
        scaled = f", scaled from 640x480 to {width_px}x{height_px}" if is_scaled else ""
        note = f"the camera is the published one of fr{group.group(1)}, by the folder's name{scaled}"
        published = FolderCamera(camera, lens=_LENSES.get(group.group(1)), note=note)
    found = read_folder_camera(folder, width_px, height_px, published)
    if found is None:
        raise DatasetError(
            f"{folder}: the camera is unknown: expected {example_camera_file(width_px, height_px)}, or a folder named "
            "after fr1, fr2 or fr3 (or freiburg1 ...) with images of 4:3"
        )
    return found
