"""Decide which surfaces depth images contradict: a camera that measures a depth behind a point sees through it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeAlias

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64
from numpy import ndarray

from gausslite.datasets.files import resize_depth
from gausslite.domain.camera import Camera
from gausslite.domain.frame import Frame
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.pose import inverse, transform_points
from gausslite.render.rasterizer import NEAR_M

_THROUGH_M, _THROUGH_SHARE = 0.04, 0.02
"""A point is seen through if the depth behind it is farther by this: 10 cm at 3 m."""
_SHOWN_M, _SHOWN_SHARE = 0.02, 0.01
"""A surface is at a point if it is within this: 5 cm at 3 m. Between both limits nothing is decided."""
_GUESSED_M, _GUESSED_SHARE = 0.05, 0.05
"""A surface was measured at a Gaussian if it is within this: 20 cm at 3 m."""
_FAR_M = 4.0
"""From here on, sensors miss surfaces because of their range. Limits of 3.6 and 4.8 m gave the same figures."""
_NEIGHBOURS = np.ones((5, 5), np.uint8)
_MIN_VIEWS = 3
_MIN_RATIO = 2
"""Views that see through a point must be at least three, and twice those that show a surface there."""
REDUCED_WIDTH_PX = 160
"""Of the depth images that a run keeps: a pixel is 2 cm wide at 2.7 m."""

_Pixels: TypeAlias = tuple[Int64[ndarray, " m"], Int64[ndarray, " m"], Int64[ndarray, " m"]]
"""Indices of points inside an image, and the rows and columns of their pixels."""


@dataclass(frozen=True, eq=False)
class DepthView:
    """A depth image, and the nearest depth around each pixel: 0 beside unmeasured pixels."""

    camera: Camera
    T_camera_world: Float64[ndarray, "4 4"]
    depth_m: Float32[ndarray, "h w"]
    nearest_m: Float32[ndarray, "h w"]  # least depth around a pixel, so that nothing beside a border is seen through

    @cached_property
    def farthest_m(self) -> Float32[ndarray, "h w"]:
        """The farthest depth around each pixel, which `sees_through` does not need."""
        farthest_m: Float32[ndarray, "h w"] = cv2.dilate(self.depth_m, _NEIGHBOURS)
        return farthest_m

    @classmethod
    def of(cls, depth_m: Float32[ndarray, "h w"], camera: Camera, T_world_camera: Float64[ndarray, "4 4"]) -> DepthView:
        """Return the view of a depth image; depth 0 means no measurement."""
        return cls(camera, inverse(T_world_camera), depth_m, cv2.erode(depth_m, _NEIGHBOURS))

    @classmethod
    def reduced(cls, frame: Frame) -> DepthView:
        """Return the view of a frame's reduced depth, which a run keeps."""
        camera = frame.camera.narrower(REDUCED_WIDTH_PX)
        return cls.of(resize_depth(frame.depth_m, (camera.width_px, camera.height_px)), camera, frame.T_world_camera)

    @classmethod
    def of_frame(cls, frame: Frame) -> DepthView:
        """Return the view of a frame."""
        return cls.of(frame.depth_m, frame.camera, frame.T_world_camera)

    def sees_through(
        self, points_m: Float32[ndarray, "n 3"], slack_m: float = _THROUGH_M, slack_share: float = _THROUGH_SHARE
    ) -> Bool[ndarray, " n"]:
        """Return the points that the camera sees through: depth around is farther by slack_m + slack_share · z."""
        z_m, nearest_m, _ = self._locate(points_m)
        return _is_before(z_m, nearest_m, slack_m, slack_share)

    def classify(self, points_m: Float32[ndarray, "n 3"]) -> tuple[Bool[ndarray, " n"], Bool[ndarray, " n"]]:
        """Return which points the camera sees through, and at which it sees a surface; all others are unknown."""
        z_m, nearest_m, (ids, rows, columns) = self._locate(points_m)
        farthest_m = np.zeros_like(nearest_m)
        farthest_m[ids] = self.farthest_m[rows, columns]
        slack_m = np.float32(_SHOWN_M) + np.float32(_SHOWN_SHARE) * z_m
        shown = (nearest_m > 0) & (z_m >= nearest_m - slack_m) & (z_m <= farthest_m + slack_m)
        return _is_before(z_m, nearest_m, _THROUGH_M, _THROUGH_SHARE), shown

    def occludes(self, points_m: Float32[ndarray, "n 3"]) -> Bool[ndarray, " n"]:
        """Return the points that are behind the surface that the camera sees."""
        z_m, nearest_m, _ = self._locate(points_m)
        return (nearest_m > 0) & (z_m > nearest_m + np.float32(_THROUGH_M) + np.float32(_THROUGH_SHARE) * z_m)

    def _locate(
        self, points_m: Float32[ndarray, "n 3"]
    ) -> tuple[Float32[ndarray, " n"], Float32[ndarray, " n"], _Pixels]:
        """Return each point's depth and the nearest depth around its pixel, 0 outside the image; and the pixels."""
        points = transform_points(self.T_camera_world, points_m)
        ids, rows, columns = _pixels(points, self.camera)
        nearest_m = np.zeros(len(points), np.float32)
        nearest_m[ids] = self.nearest_m[rows, columns]
        return np.maximum(points[:, 2], np.float32(0.0)), nearest_m, (ids, rows, columns)


def _is_before(
    z_m: Float32[ndarray, " n"], nearest_m: Float32[ndarray, " n"], slack_m: float, slack_share: float
) -> Bool[ndarray, " n"]:
    before: Bool[ndarray, " n"] = z_m < nearest_m - (np.float32(slack_m) + np.float32(slack_share) * z_m)
    return before


def _pixels(points_m: Float32[ndarray, "n 3"], camera: Camera) -> _Pixels:
    """Return the indices of the points inside the image, in the camera's frame, and their pixels' rows and columns."""
    x_m, y_m, z_m = points_m.T
    in_front = z_m > NEAR_M
    inverse_z = 1.0 / np.where(in_front, z_m, np.float32(1.0))
    columns, rows = camera.pixels(x_m * inverse_z, y_m * inverse_z)
    inside = in_front & (rows >= 0) & (rows < camera.height_px) & (columns >= 0) & (columns < camera.width_px)
    ids = np.flatnonzero(inside)
    return ids, rows[ids].astype(np.int64), columns[ids].astype(np.int64)


def view_counts(
    points_m: Float32[ndarray, "n 3"], views: Iterable[DepthView]
) -> tuple[Int64[ndarray, " n"], Int64[ndarray, " n"]]:
    """Return how many views see through each point, and how many show a surface there."""
    through, shown = (np.zeros(len(points_m), np.int64) for _ in range(2))
    for view in views:
        view_through, view_shown = view.classify(points_m)
        through += view_through
        shown += view_shown
    return through, shown


def seen_through(
    points_m: Float32[ndarray, "n 3"], views: Iterable[DepthView], min_views: int = _MIN_VIEWS
) -> Bool[ndarray, " n"]:
    """Return the points that these views contradict: enough see through them, and few show a surface there."""
    through, shown = view_counts(points_m, views)
    return (through >= min_views) & (through >= _MIN_RATIO * shown)


def without_guesses(gaussians: Gaussians, frames: Iterable[Frame]) -> Gaussians:
    """Return a map for others: without untrained Gaussians whose distance is a guess of 4 m or more."""
    untrained = np.flatnonzero(gaussians.kappa == 0)
    guessed = has_guessed_depth(gaussians.means_m[untrained], frames)
    return gaussians.take(np.delete(np.arange(len(gaussians)), untrained[guessed]))


def has_guessed_depth(points_m: Float32[ndarray, "n 3"], frames: Iterable[Frame]) -> Bool[ndarray, " n"]:
    """Return the points at pixels without a depth, if no frame shows them within 4 m or with a measured surface there.

    Their distance is a guess: the surface may lie beyond the sensor's range, so that they float in other views.
    """
    guessed = np.zeros(len(points_m), np.bool_)
    ids = np.arange(len(points_m))
    for frame in frames:
        points = transform_points(inverse(frame.T_world_camera), points_m[ids])
        inside, rows, columns = _pixels(points, frame.camera)
        z_m, depth_m = points[inside, 2], frame.depth_m[rows, columns]
        measured = (depth_m > 0) & (np.abs(z_m - depth_m) <= _GUESSED_M + _GUESSED_SHARE * z_m)
        near = z_m < _FAR_M
        guessed[ids[inside[depth_m == 0]]] = True
        guessed[ids[inside[measured | near]]] = False
        ids = np.delete(ids, inside[measured | near])
    return guessed


def contradicted_rows(
    means_m: Float32[ndarray, "n 3"], newest: Frame, keyframes: Iterable[Frame]
) -> Int64[ndarray, " m"]:
    """Return the rows of the means that the newest frame sees through and that these keyframes contradict."""
    rows = np.flatnonzero(DepthView.of_frame(newest).classify(means_m)[0])
    if len(rows) == 0:
        return rows
    contradicted: Int64[ndarray, " m"] = rows[seen_through(means_m[rows], map(DepthView.of_frame, keyframes))]
    return contradicted


def rows_moved_away(
    means_m: Float32[ndarray, "n 3"], frame: Frame, moved: Bool[ndarray, "h w"], others: Iterable[Frame]
) -> Int64[ndarray, " m"]:
    """Return the rows of the means that a frame shows on pixels that moved later, and that other frames contradict.

    Two views suffice: the pixels have been compared before.
    """
    view = DepthView.of_frame(frame)
    view = replace(view, nearest_m=np.where(moved, view.nearest_m, np.float32(0.0)))
    rows = np.flatnonzero(view.classify(means_m)[1])
    moved_away: Int64[ndarray, " m"] = rows[seen_through(means_m[rows], map(DepthView.of_frame, others), min_views=2)]
    return moved_away
