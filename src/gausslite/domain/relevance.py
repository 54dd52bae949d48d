"""The relevance w(u, v) of each pixel to the task, the detections it comes from, and ground-truth regions of space."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int16, Int64, UInt8
from numpy import ndarray

from gausslite.domain.arrays import require_array
from gausslite.domain.camera import Camera, back_project, project
from gausslite.domain.checks import require_number, require_types
from gausslite.domain.errors import InvalidInputError
from gausslite.domain.frame import Frame
from gausslite.domain.pose import inverse, transform_points

_MAX_COORDINATE_M = 1e6
_NEAR_M = 1e-3
MIN_ROI_PIXELS = 64
"""A view with fewer region pixels does not show the region: it is not scored there, and pictures avoid it."""
PointM = tuple[float, float, float]
"""A point in the world in metres."""
UNNAMED: Final = "object"
"""The noun of an object that a person points at without a word."""
NO_TARGET = -1


@runtime_checkable
class Region(Protocol):
    """A region with an exact mask in any frame."""

    def mask(self, frame: Frame) -> Bool[ndarray, "h w"]:
        """Return True where the frame shows the region."""


@dataclass(frozen=True, slots=True)
class BallRegion:
    """All surface points within radius_m of a world point."""

    centre_m: tuple[float, float, float]  # in the world
    radius_m: float

    def __post_init__(self) -> None:
        require_types(centre_m=(self.centre_m, (tuple, list, ndarray)))
        for value in (*self.centre_m, self.radius_m):
            require_number("ball", value)
        # farther out, float32 does not resolve 0.1 m
        limit_m = _MAX_COORDINATE_M
        if not (len(self.centre_m) == 3 and max(map(abs, self.centre_m)) <= limit_m and 0 < self.radius_m <= limit_m):
            raise InvalidInputError(
                f"ball: expected a centre within ±{limit_m:g} m and a radius of 0 to {limit_m:g} m, "
                f"got {self.centre_m} and {self.radius_m}"
            )

    def mask(self, frame: Frame) -> Bool[ndarray, "h w"]:
        """Return True where the pixel's back-projected point is in the ball."""
        centre = np.asarray(self.centre_m)
        window = _image_window(frame, centre - self.radius_m, centre + self.radius_m)
        offsets = _world_points(frame, window) - centre.astype(np.float32)
        result = np.zeros(frame.depth_m.shape, np.bool_)
        result[window] = (np.square(offsets).sum(axis=-1) <= self.radius_m**2) & (frame.depth_m[window] > 0)
        return result


@dataclass(frozen=True, slots=True)
class TargetPoint:
    """A point in the world that a person gives as the target: all within radius_m of it, None for the object there."""

    point_m: tuple[float, float, float]
    radius_m: float | None = None

    def __post_init__(self) -> None:
        self.ball()

    def ball(self) -> BallRegion:
        """Return the ball of the radius, of a metre without one. Raises InvalidInputError."""
        return BallRegion(self.point_m, 1.0 if self.radius_m is None else self.radius_m)


@dataclass(frozen=True, slots=True)
class PointedObject:
    """One object that a person points at: by points (x, y) and boxes (left, top, right, bottom) on a keyframe's image,
    or by a point in the world on a surface that a keyframe shows.

    frame_index: of the keyframe; None for the newest. noun: what it is, for the team.
    """

    points_px: tuple[tuple[float, float], ...] = ()
    boxes_px: tuple[tuple[float, float, float, float], ...] = ()
    point_m: PointM | None = None
    frame_index: int | None = None
    noun: str = UNNAMED

    def __post_init__(self) -> None:
        if (self.point_m is not None) == bool(self.points_px or self.boxes_px):
            raise InvalidInputError(
                "pointed object: expected points and boxes in pixels, or a point_m, got both or none"
            )


@dataclass(frozen=True, slots=True, eq=False)
class VoxelRegion:
    """Surface points in the listed voxels floor(p / size) or their neighbours."""

    voxels: Int64[ndarray, "n 3"]
    size_m: float

    def mask(self, frame: Frame) -> Bool[ndarray, "h w"]:
        """Return True where the pixel's back-projected point is in the listed voxels, dilated by one."""
        low = self.voxels.min(axis=0) - 2
        shape = self.voxels.max(axis=0) + 3 - low
        occupied = np.zeros(shape, np.bool_)
        i, j, k = (self.voxels - low).T
        for di in (-1, 0, 1):
            for dj in (-1, 0, 1):
                for dk in (-1, 0, 1):
                    occupied[i + di, j + dj, k + dk] = True
        window = _image_window(frame, low * self.size_m, (low + shape) * self.size_m)
        index = np.floor(_world_points(frame, window) / np.float32(self.size_m)).astype(np.int64) - low
        inside = ((index >= 0) & (index < shape)).all(axis=-1) & (frame.depth_m[window] > 0)
        result = np.zeros(frame.depth_m.shape, np.bool_)
        result[window][inside] = occupied[tuple(index[inside].T)]
        return result

    @property
    def centroid_m(self) -> Float[ndarray, "3"]:
        """Mean of the listed voxels' centres."""
        centroid: Float[ndarray, "3"] = (self.voxels.mean(axis=0) + 0.5) * self.size_m
        return centroid


def _image_window(frame: Frame, low_m: Float[ndarray, "3"], high_m: Float[ndarray, "3"]) -> tuple[slice, slice]:
    """Return rows and columns of the image that contain all pixels of this box in the world."""
    height, width = frame.depth_m.shape
    bounds_m = np.stack([low_m, high_m]).astype(np.float64)
    p_world = np.stack(np.meshgrid(*bounds_m.T, indexing="ij"), axis=-1).reshape(-1, 3)
    p_camera = transform_points(inverse(frame.T_world_camera), p_world)
    if (p_camera[:, 2] < _NEAR_M).any() or (frame.motion is not None and frame.motion.readout_s != 0.0):
        return slice(0, height), slice(0, width)
    pixels = project(p_camera.astype(np.float32), frame.camera)
    # one more pixel on every side, for rounding
    left, top = np.clip(np.floor(pixels.min(axis=0)) - 1, 0, (width, height)).astype(int).tolist()
    right, bottom = np.clip(np.ceil(pixels.max(axis=0)) + 1, 0, (width, height)).astype(int).tolist()
    return slice(top, bottom), slice(left, right)


def _world_points(frame: Frame, window: tuple[slice, slice]) -> Float[ndarray, "h w 3"]:
    rows, columns = window
    points = back_project(frame.depth_m[window], frame.camera, columns.start, rows.start)
    if frame.motion is not None:
        row_shares = (np.arange(rows.start, rows.stop) + 0.5) / frame.camera.height_px
        pixel_shares = np.repeat(row_shares, points.shape[1])
        moved = frame.motion.to_middle_row(points.reshape(-1, 3).astype(np.float64), pixel_shares)
        points = moved.astype(np.float32).reshape(points.shape)
    return transform_points(frame.T_world_camera, points)


@dataclass(frozen=True, slots=True)
class CompetingClass:
    """A class of a different thing that a detector finds in the same place, and its score."""

    name: str  # the class that was detected
    score: float


@dataclass(frozen=True, slots=True, eq=False)
class Detection:
    """One detected object in one image. box_px is (left, top, right, bottom).

    is_weak: the score is below the detector's threshold. It supports an object that other frames found, nothing else.
    """

    phrase: str  # the noun that was searched
    score: float
    box_px: tuple[float, float, float, float]
    mask: Bool[ndarray, "h w"]  # the object's pixels
    rival: CompetingClass | None = None  # None without another class
    is_weak: bool = False
    is_exact: bool = False  # the mask is ground truth, not a network's
    class_name: str = ""  # of the detector, empty if it has none


@dataclass(frozen=True, slots=True)
class DetectedBox:
    """A detection without a mask; see Detection."""

    phrase: str
    score: float
    box_px: tuple[float, float, float, float]  # left, top, right, bottom
    rival: CompetingClass | None = None
    is_weak: bool = False
    class_name: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class DetectedImage:
    """What the detector has found in one image, objects that the task leaves out included."""

    index: int  # of the frame
    rgb: UInt8[ndarray, "h w 3"]
    boxes: tuple[DetectedBox, ...]  # what was found, the weak ones too

    @classmethod
    def of(cls, frame: Frame, detections: Sequence[Detection]) -> DetectedImage:
        """Return the frame's image with the boxes of its detections."""
        return cls(
            frame.index,
            frame.rgb,
            tuple(
                DetectedBox(found.phrase, found.score, found.box_px, found.rival, found.is_weak, found.class_name)
                for found in detections
            ),
        )


@dataclass(frozen=True, slots=True, eq=False)
class CameraView:
    """The newest keyframe, its pose, and the poses of all frames and keyframes, in the map.

    detected: what the detector found in the image on which it ran last; None without a detector.
    """

    rgb: UInt8[ndarray, "h w 3"]
    roi: Bool[ndarray, "h w"]  # True in the task's region
    camera: Camera
    frame_index: int
    T_world_camera: Float64[ndarray, "4 4"]
    times_ns: Int64[ndarray, " t"]  # of the path, oldest first; they go on where the clock was set
    path: Float64[ndarray, "t 4 4"]  # pose of each mapped frame
    keyframes: Float64[ndarray, "k 4 4"]
    detected: DetectedImage | None = None


@dataclass(frozen=True, slots=True, eq=False)
class RelevanceMap:
    """Relevance of one frame."""

    pixel_weights: Float32[ndarray, "h w"]  # the paper's w(u, v), in [0, 1]
    target: Int16[ndarray, "h w"]  # for each pixel, the index of its target in TaskGraph.targets, -1 for none
    known_objects: int = 0  # how many objects of the task were known when this was estimated

    def __post_init__(self) -> None:
        require_array("relevance pixel_weights", self.pixel_weights, (None, None), np.float32)
        require_array("relevance target", self.target, self.pixel_weights.shape, np.int16)

    @classmethod
    def empty(cls, height_px: int, width_px: int) -> RelevanceMap:
        """Return a map without relevant pixels."""
        return cls(
            np.zeros((height_px, width_px), np.float32),
            np.full((height_px, width_px), NO_TARGET, np.int16),
        )

    def without(self, pixels: Bool[ndarray, "h w"]) -> RelevanceMap:
        """Return the map without the relevance of these pixels."""
        target = np.where(pixels, np.int16(NO_TARGET), self.target)
        return RelevanceMap(np.where(pixels, np.float32(0), self.pixel_weights), target, self.known_objects)

    @property
    def roi(self) -> Bool[ndarray, "h w"]:
        """True for pixels of the task's region."""
        return self.pixel_weights > 0

    @property
    def roi_share(self) -> float:
        """Fraction of pixels in the task's region."""
        return float(np.count_nonzero(self.pixel_weights) / self.pixel_weights.size)
