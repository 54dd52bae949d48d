"""Regions that a person points at: a click, a box or a point in the world grows over depth and colour."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from numbers import Real
from typing import Final

import cv2
import numpy as np
from jaxtyping import Bool, Float32
from numpy import ndarray

from gausslite.domain.camera import back_project, project
from gausslite.domain.checks import describe
from gausslite.domain.errors import InvalidInputError
from gausslite.domain.frame import Frame
from gausslite.domain.pose import inverse, transform_points
from gausslite.domain.relevance import PointedObject, Region
from gausslite.perception.lifting import without_background_planes
from gausslite.perception.surface import SurfaceVotes, mask_votes, surface_mask
from gausslite_detectors.depth_segmenter import DepthSegmenter

_NEAR_M: Final = 0.05
_MAX_SHARE: Final = 1 / 3
"""Of a frame's pixels with depth, that the region of a click may have. Floods of the kitchen's table have 0.38."""


@dataclass(frozen=True, slots=True)
class PointingSettings:
    """How a region grows around a point. With these values, 500 clicks in four homes have an IoU of 0.53.

    radii_m: balls around the point, the smallest first; the first that contains the connected surface wins.
    max_reach_share: of the radius, that the surface may reach. min_ball_share: of the ball's pixels, that the surface
    has; fewer are a speck beside a plane. seed_px: the surface's largest distance from the point. gap_px: gaps in depth
    that do not divide a surface. plane_m, plane_share: distance from a plane, in metres and as a share of depth.
    colour_step: in Lab units, from a plane's median colour to that of a thing on it. max_border_share: of a thing's
    outline, that is also the plane's. min_thing_share: of the plane, that a thing has. max_error_m: between a point in
    the world and the depth of a frame that shows it. error_step_m: smaller differences of this error do not matter.
    """

    radii_m: tuple[float, ...] = (0.1, 0.14, 0.2, 0.28, 0.4, 0.56, 0.8)
    max_reach_share: float = 0.9
    max_error_m: float = 0.03
    error_step_m: float = 0.005
    min_ball_share: float = 0.1
    seed_px: int = 3
    gap_px: int = 5
    plane_m: float = 0.015
    plane_share: float = 0.01
    colour_step: float = 20.0
    max_border_share: float = 0.3
    min_thing_share: float = 0.005


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceRegion:
    """A Region: the surface that votes of masks have measured."""

    votes: SurfaceVotes

    def mask(self, frame: Frame) -> Bool[ndarray, "h w"]:
        """Return True where the frame shows the surface."""
        return surface_mask(self.votes, frame)


def region_on_image(
    frame: Frame,
    points_px: Sequence[tuple[float, float]] = (),
    boxes_px: Sequence[tuple[float, float, float, float]] = (),
) -> Region:
    """Return the region of points (x, y) and boxes (left, top, right, bottom) on one frame, as one object.

    Raises InvalidInputError for a point outside the image, a point or box without depth, and a point from which the
    region would flood the image.
    """
    return SurfaceRegion(mask_votes(mask_on_image(frame, points_px, boxes_px), frame))


def mask_on_image(
    frame: Frame,
    points_px: Sequence[tuple[float, float]] = (),
    boxes_px: Sequence[tuple[float, float, float, float]] = (),
) -> Bool[ndarray, "h w"]:
    """Return the mask of points and boxes as `region_on_image` does. Raises InvalidInputError."""
    if not (points_px or boxes_px):
        raise InvalidInputError("points: expected at least one point or box, got none")
    for name, count, listed in (("points_px", 2, points_px), ("boxes_px", 4, boxes_px)):
        for numbers in listed:
            _require_numbers(name, numbers, count)
    settings = PointingSettings()
    mask = np.zeros(frame.depth_m.shape, np.bool_)
    for x, y in points_px:
        grown = _grown(frame, *_pixel(frame, x, y), settings)
        _require_object(f"point {x:g},{y:g}", frame, grown, "draw a box")
        mask |= grown
    for box in boxes_px:
        mask |= _in_box(frame, box, settings)
    return mask


def region_at(point_m: tuple[float, float, float], frames: Iterable[Frame]) -> Region:
    """Return the region around a point in the world, grown on the frame that shows the point best.

    Of frames that measure the same place, this is the nearest. Raises InvalidInputError if none shows the point.
    """
    frame, mask = mask_at(point_m, frames)
    return SurfaceRegion(mask_votes(mask, frame))


def mask_at(point_m: tuple[float, float, float], frames: Iterable[Frame]) -> tuple[Frame, Bool[ndarray, "h w"]]:
    """Return the frame that shows a point best, and the mask as `region_at` grows it. Raises InvalidInputError."""
    _require_numbers("point_m", point_m, 3)
    settings = PointingSettings()
    best: tuple[tuple[int, float], Frame, tuple[int, int]] | None = None
    for frame in frames:
        seen = _seen(frame, point_m, settings)
        if seen is not None and (best is None or seen[0] < best[0]):
            best = seen[0], frame, seen[1]
    if best is None:
        place = ",".join(f"{value:g}" for value in point_m)
        raise InvalidInputError(f"target {place}: expected a point on a surface that a frame shows, none shows it")
    _, frame, (row, column) = best
    mask = _grown(frame, row, column, settings)
    place = ",".join(f"{value:g}" for value in point_m)
    _require_object(f"target {place}", frame, mask, f"state a radius ({place},RADIUS) or draw a box")
    return frame, mask


def _require_object(place: str, frame: Frame, mask: Bool[ndarray, "h w"], advice: str) -> None:
    """Raise InvalidInputError if a region has more of a frame's pixels with depth than most objects have."""
    share = np.count_nonzero(mask) / np.count_nonzero(frame.depth_m > 0)
    if share > _MAX_SHARE:
        raise InvalidInputError(
            f"{place}: expected one object, its region would have {share:.0%} of frame {frame.index}; {advice}"
        )


def _require_numbers(name: str, value: object, count: int) -> None:
    """Raise InvalidInputError unless the value is so many numbers."""
    numbers = list(value) if isinstance(value, tuple | list | np.ndarray) else []
    if len(numbers) != count or not all(isinstance(number, Real) for number in numbers):
        raise InvalidInputError(f"{name}: expected {count} numbers each, got {describe(value)}")


def pointed_masks(
    pointed: Iterable[PointedObject], keyframes: Sequence[Frame]
) -> list[tuple[str, Bool[ndarray, "h w"], Frame]]:
    """Return noun, mask and frame of each object pointed at; keyframes: oldest first. Raises InvalidInputError."""
    masks = []
    for shown in pointed:
        if shown.point_m is not None:
            frame, mask = mask_at(shown.point_m, keyframes)
        else:
            frame = _keyframe(shown.frame_index, keyframes)
            mask = mask_on_image(frame, shown.points_px, shown.boxes_px)
        masks.append((shown.noun, mask, frame))
    return masks


def _keyframe(index: int | None, keyframes: Sequence[Frame]) -> Frame:
    """Return the keyframe of an index, the newest for None. Raises InvalidInputError."""
    frame = next((frame for frame in reversed(keyframes) if index in (None, frame.index)), None)
    if frame is None:
        kept = ", ".join(str(frame.index) for frame in keyframes[-4:])
        expected = f"a keyframe that is kept, such as {kept}" if kept else "a mapped frame first"
        raise InvalidInputError(f"frame_index: expected {expected}; got {index}")
    return frame


def _pixel(frame: Frame, x: float, y: float) -> tuple[int, int]:
    """Return row and column of a point on the image. Raises InvalidInputError outside it and without depth."""
    height, width = frame.depth_m.shape
    if not (0 <= x < width and 0 <= y < height):
        raise InvalidInputError(f"point {x:g},{y:g}: expected a pixel of the image of {width}x{height}")
    row, column = int(y), int(x)
    if not frame.depth_m[row, column] > 0:
        raise InvalidInputError(f"point {x:g},{y:g}: expected depth, frame {frame.index} has none there; draw a box")
    return row, column


def _in_box(frame: Frame, box: tuple[float, float, float, float], settings: PointingSettings) -> Bool[ndarray, "h w"]:
    """Return the part inside a box of what grows from the box's main surface. Raises InvalidInputError."""
    height, width = frame.depth_m.shape
    left, top, right, bottom = box
    text = ",".join(f"{value:g}" for value in box)
    if not (0 <= left < right <= width and 0 <= top < bottom <= height):
        raise InvalidInputError(f"box {text}: expected left,top,right,bottom in the image of {width}x{height}")
    (main,) = DepthSegmenter().segment(frame, np.array([box], np.float32))
    rows, columns = np.nonzero((frame.depth_m > 0) & (False if main is None else main))
    if len(rows) == 0:
        raise InvalidInputError(f"box {text}: expected pixels with depth, frame {frame.index} has none there")
    middle = int(np.argmin((rows - rows.mean()) ** 2 + (columns - columns.mean()) ** 2))
    inside = np.zeros(frame.depth_m.shape, np.bool_)
    inside[int(top) : int(np.ceil(bottom)), int(left) : int(np.ceil(right))] = True
    return _grown(frame, int(rows[middle]), int(columns[middle]), settings) & inside


def _seen(
    frame: Frame, point_m: tuple[float, float, float], settings: PointingSettings
) -> tuple[tuple[int, float], tuple[int, int]] | None:
    """Return (steps to the measured depth, distance) and the pixel (row, column) of a point; None if not shown."""
    p_camera = transform_points(inverse(frame.T_world_camera), np.array([point_m]))
    z_m = float(p_camera[0, 2])
    if z_m < _NEAR_M:
        return None
    column, row = np.floor(project(p_camera.astype(np.float32), frame.camera)[0]).astype(int).tolist()
    height, width = frame.depth_m.shape
    if not (0 <= row < height and 0 <= column < width and frame.depth_m[row, column] > 0):
        return None
    error_m = abs(z_m - float(frame.depth_m[row, column]))
    if error_m > settings.max_error_m:
        return None
    return (int(error_m / settings.error_step_m), float(np.linalg.norm(p_camera))), (row, column)


def _grown(frame: Frame, row: int, column: int, settings: PointingSettings) -> Bool[ndarray, "h w"]:
    """Return the connected surface around a pixel with depth, without the planes behind and below it.

    If no ball contains such a surface, as on a table or a wall, the plane through the pixel is it.
    """
    points_m = back_project(frame.depth_m, frame.camera)
    distance_m = np.where(frame.depth_m > 0, np.linalg.norm(points_m - points_m[row, column], axis=2), np.inf)
    for radius_m in settings.radii_m:
        ball = distance_m <= radius_m
        standing = without_background_planes(ball, frame.depth_m, frame.camera)
        seed = _nearest(standing, row, column, settings.seed_px)
        if seed is not None:
            surface = _connected(standing, seed, settings)
            is_contained = np.percentile(distance_m[surface], 98) <= settings.max_reach_share * radius_m
            if is_contained and np.count_nonzero(surface) >= settings.min_ball_share * np.count_nonzero(ball):
                return surface
    return _on_plane(frame, points_m, distance_m, (row, column), settings)


def _on_plane(
    frame: Frame,
    points_m: Float32[ndarray, "h w 3"],
    distance_m: Float32[ndarray, "h w"],
    seed: tuple[int, int],
    settings: PointingSettings,
) -> Bool[ndarray, "h w"]:
    """Return the connected part of the plane through a pixel, or a thing of another colour in it that has the pixel.

    Where the surface is no plane, it grows a little, as far as depth and colour are continuous.
    """
    limits_m = np.maximum(settings.plane_m, settings.plane_share * frame.depth_m)
    plane = distance_m <= settings.radii_m[0]
    for radius_m in settings.radii_m[::3]:  # a larger part has a more exact normal
        own_m = points_m[plane].astype(np.float64)
        middle_m = own_m.mean(axis=0)
        normal = np.linalg.eigh((own_m - middle_m).T @ (own_m - middle_m))[1][:, 0]
        near = (distance_m <= radius_m) & (np.abs((points_m - middle_m) @ normal) <= limits_m)
        if not near[seed]:
            return DepthSegmenter().grow(frame, seed, distance_m <= settings.radii_m[2])
        plane = _connected(near, seed, settings)
    lab = cv2.cvtColor(cv2.GaussianBlur(frame.rgb, (3, 3), 0).astype(np.float32) / 255, cv2.COLOR_RGB2LAB)
    differs = plane & (np.linalg.norm(lab - np.median(lab[plane], axis=0), axis=2) > settings.colour_step)
    if not differs[seed]:
        return plane
    thing = _filled(_connected(differs, seed, settings)) & plane
    outline = thing & ~_eroded(thing, 1)
    border = outline & ~_eroded(_filled(plane), 2)
    is_inside = np.count_nonzero(border) <= settings.max_border_share * np.count_nonzero(outline)
    is_speck = np.count_nonzero(thing) < settings.min_thing_share * np.count_nonzero(plane)
    return thing if is_inside and not is_speck else plane


def _filled(mask: Bool[ndarray, "h w"]) -> Bool[ndarray, "h w"]:
    """Return a mask with its holes."""
    outlines, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return cv2.drawContours(np.zeros(mask.shape, np.uint8), outlines, -1, 1, cv2.FILLED) > 0


def _eroded(mask: Bool[ndarray, "h w"], by_px: int) -> Bool[ndarray, "h w"]:
    """Return a mask without the pixels next to others."""
    return cv2.erode(mask.astype(np.uint8), np.ones((2 * by_px + 1, 2 * by_px + 1), np.uint8)) > 0


def _nearest(mask: Bool[ndarray, "h w"], row: int, column: int, within_px: int) -> tuple[int, int] | None:
    """Return the mask's nearest pixel to another, within a distance; None if there is none."""
    top, left = max(0, row - within_px), max(0, column - within_px)
    rows, columns = np.nonzero(mask[top : row + within_px + 1, left : column + within_px + 1])
    if len(rows) == 0:
        return None
    best = int(np.argmin((rows + top - row) ** 2 + (columns + left - column) ** 2))
    return int(rows[best]) + top, int(columns[best]) + left


def _connected(mask: Bool[ndarray, "h w"], seed: tuple[int, int], settings: PointingSettings) -> Bool[ndarray, "h w"]:
    """Return the part of a mask around a pixel; gaps of few pixels do not divide it."""
    gap = np.ones((settings.gap_px, settings.gap_px), np.uint8)
    closed = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_CLOSE, gap)
    _, labels = cv2.connectedComponents(closed, connectivity=4)
    part: Bool[ndarray, "h w"] = mask & (labels == labels[seed])
    return part
