"""Bases of the readers of recorded sequences: what all folder layouts have in common."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import numpy as np
from jaxtyping import Float, Float64
from numpy import ndarray

from gausslite.datasets.camera_files import FolderCamera
from gausslite.datasets.files import DepthUnits
from gausslite.datasets.regions import REGIONS_FILE, balls_for_small_objects, load_voxel_regions
from gausslite.datasets.source import Source
from gausslite.domain.camera import Camera
from gausslite.domain.frame import MAX_COORDINATE_M
from gausslite.domain.lens import Lens
from gausslite.domain.pose import UpAxis
from gausslite.domain.relevance import Region

FIRST_VIEW_UP = (0.0, -1.0, 0.0)
"""Upward direction of a world that a level first view defines."""
_LEVEL_COSINE = 0.8
"""Cameras without roll show up within about 20 degrees; rarely level ones within 37."""
_ORIGIN_STEP_M = 10_000.0
_EARTH_DIAMETER_M = 1.3e7


def is_lost(translation_m: Float64[ndarray, "3"], rotation: Float64[ndarray, "..."]) -> bool:
    """True if a tracker wrote no pose: no finite number, or a quaternion or matrix of zeros."""
    return not (np.isfinite(translation_m).any() or np.isfinite(rotation).any()) or not rotation.any()


def estimate_up(
    rotations_world_camera: Float64[ndarray, "n 3 3"], fallback: tuple[float, float, float]
) -> tuple[float, float, float]:
    """Return the up direction for a camera without roll: perpendicular to the image rows of all views.

    The camera's x axes then lie in the ground plane, and up is the direction of their smallest variance. Returns the
    fallback if the views turn too little for the x axes to span a plane.
    """
    x_axes: Float[ndarray, "n 3"] = rotations_world_camera[:, :, 0]
    variances, directions = np.linalg.eigh(x_axes.T @ x_axes / max(len(x_axes), 1))
    if variances[1] < 0.05 or variances[1] < 5 * variances[0]:
        return fallback
    up = directions[:, 0]
    if up @ rotations_world_camera[:, :, 1].mean(axis=0) > 0:
        up = -up
    return (float(up[0]), float(up[1]), float(up[2]))


def up_note(rotations_world_camera: Float64[ndarray, "n 3 3"], up_axis: UpAxis) -> str:
    """Return the message on images that show another up, which hardly turned ones do by their upper side, else ""."""
    images, shown = "images", np.array(estimate_up(rotations_world_camera, up_axis))
    right, down, ahead = rotations_world_camera.sum(axis=0).T / max(len(rotations_world_camera), 1)
    level = _LEVEL_COSINE
    if shown @ up_axis > level:
        if np.linalg.norm(down) < level or down @ up_axis < -level / 2 or ahead @ up_axis < -level:
            return ""
        images, shown = "upright images", -down / np.linalg.norm(down)
    stated, found = (",".join(f"{value + 0.0:.2g}" for value in np.round(axis, 2)) for axis in (up_axis, shown))
    if abs(right @ up_axis) > level:
        # a camera in portrait has the poses of a level one in a world that lies on its side
        return f"{images} show up as {found}, those held on their side as {stated}: state up={found} or up={stated}"
    return f"{images} show up as {found}, not as {stated}; 'on', heights and grids need it: state up={found}"


@dataclass(frozen=True, slots=True)
class Origin:
    """The point of a recording's world that is the map's origin: zero, but for poses far away, such as those of UTM.

    It is a multiple of 10 km, so that recordings of one place have the same.
    """

    position_m: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @classmethod
    def near(cls, positions_m: Float64[ndarray, "n 3"]) -> Origin:
        """Return the origin for cameras at these positions; single outliers do no harm."""
        finite_m = positions_m[np.isfinite(positions_m).all(axis=1)]
        median_m = np.median(finite_m, axis=0) if len(finite_m) else np.zeros(3)
        if not MAX_COORDINATE_M < np.abs(median_m).max() < _EARTH_DIAMETER_M:
            return cls()
        x_m, y_m, z_m = (np.round(median_m / _ORIGIN_STEP_M) * _ORIGIN_STEP_M).tolist()
        return cls((x_m, y_m, z_m))

    def moved(self, T_world_camera: Float64[ndarray, "4 4"]) -> Float64[ndarray, "4 4"]:
        """Return the pose in the map."""
        T = T_world_camera.copy()
        T[:3, 3] -= self.position_m
        return T

    def frame(self, world: str) -> str:
        """Return the name of the map's frame: the world's own, or one with the origin."""
        return f"{world} from {self}" if any(self.position_m) else world

    @property
    def note(self) -> str:
        """Message on an origin that is not zero; empty otherwise."""
        return f"positions are far away; the map's origin is at {self} m" if any(self.position_m) else ""

    def __str__(self) -> str:
        """Return the coordinates."""
        return " ".join(f"{value:.0f}" for value in self.position_m)


class FolderSource(Source):
    """Name, camera, upward direction and regions of a sequence in a folder."""

    _found: FolderCamera
    _units: DepthUnits
    _up_axis: UpAxis
    _origin = Origin()
    _layout_has_registered_depth: bool

    def __init__(self, folder: Path) -> None:
        """Subclasses also call `_set_camera` and set `_up_axis`."""
        self._folder = folder

    def _set_camera(self, found: FolderCamera, default_units: DepthUnits) -> None:
        """Use this camera and its depth units, if it states them."""
        self._found = found
        self._units = replace(default_units, per_metre=found.units_per_metre or default_units.per_metre)

    @property
    def name(self) -> str:
        """Name of the folder."""
        return self._folder.name

    @property
    def excluded_frames(self) -> str:
        """Message on the recorded frames that are not used; empty if all are."""
        return ""

    @property
    def notes(self) -> tuple[str, ...]:
        """Messages on a camera file of another folder, on excluded frames, and on an origin that is not zero."""
        return tuple(filter(None, (self._found.note, self.excluded_frames, self._origin.note)))

    @property
    def camera(self) -> Camera:
        """Camera at the size of the recorded images."""
        return self._found.camera

    @property
    def lens(self) -> Lens | None:
        """Lens that is stated for the camera, else None."""
        return self._found.lens

    @property
    def up_axis(self) -> UpAxis:
        """The layout's upward direction, unless the caller gives another."""
        return self._up_axis

    @property
    def depth_registered(self) -> bool:
        """What the camera's file states, else what the layout guarantees."""
        stated = self._found.depth_registered
        return self._layout_has_registered_depth if stated is None else stated

    @property
    def depth_unit_stated(self) -> bool:
        """True if a camera file states it."""
        return self._found.units_per_metre is not None

    @property
    def depth_unit_setting(self) -> str:
        """A field of the camera file."""
        return "`scale` in cam_params.json"

    @property
    def world_frame(self) -> str:
        """Name of the recording, also where the folder is given as ".", with an origin that is not zero."""
        return self._origin.frame(self.name or self._folder.resolve().name)

    @property
    def regions_file(self) -> Path | None:
        """roi_voxels.npz in the folder; None without it."""
        path = self._folder / REGIONS_FILE
        return path if path.is_file() else None

    def regions(self) -> Mapping[str, Region]:
        """Return the regions of roi_voxels.npz in the folder, small objects as balls; empty without the file."""
        path = self.regions_file
        return {} if path is None else balls_for_small_objects(load_voxel_regions(path))


class FolderSourceClass(Protocol):
    """A class of sequences in folders or files, which it recognises by the names of files."""

    def __call__(self, path: Path, up_axis: UpAxis | None, require_poses: bool, /) -> Source:
        """Return the sequence. Raises DatasetError, PoseError."""

    def recognises(self, path: Path, /) -> bool:
        """True if the path has this layout."""


@dataclass(frozen=True, slots=True)
class FolderReader:
    """A SourceReader for a class of sequences in folders or files."""

    sources: FolderSourceClass
    layout: str  # the names of its files, for messages
    address: str = ""  # what it opens that is no folder, for messages

    def recognises(self, address: str) -> bool:
        """True if the path has this layout."""
        return self.sources.recognises(Path(address).expanduser())

    def open(self, address: str, up_axis: UpAxis | None, require_poses: bool) -> Source:
        """Return the sequence at the path. Raises DatasetError, PoseError."""
        return self.sources(Path(address).expanduser(), up_axis, require_poses)
