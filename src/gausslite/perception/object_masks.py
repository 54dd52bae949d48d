"""Masks of known objects in any frame, from their measured surface, and the votes of detected masks on the surface."""

from __future__ import annotations

import math
from typing import Final

import cv2
import numpy as np
from jaxtyping import Bool, Float64
from numpy import ndarray

from gausslite.domain.camera import back_project, project
from gausslite.domain.frame import Frame
from gausslite.domain.pose import inverse, transform_points
from gausslite.perception.colours import colour_counts
from gausslite.perception.detect import bounding_box
from gausslite.perception.mask_edges import snapped_to_edges
from gausslite.perception.surface_votes import SurfaceVotes

_MIN_Z_M: Final = 0.05
# pixels around a mask vote outside: a later mask that spills over them is cut back
_MARGIN_SHARE: Final = 1.0
_MIN_MARGIN_PX: Final = 8
_MAX_VOTING_PIXELS: Final = 40_000
_MIN_INNER_PIXELS: Final = 20
_MAX_COLOUR_PIXELS: Final = 500
_MAX_PROJECTED: Final = 4000
_CLOSING: Final = np.ones((5, 5), np.uint8)

Window = tuple[slice, slice]


def mask_votes(mask: Bool[ndarray, "h w"], frame: Frame, siblings: Bool[ndarray, "h w"] | None = None) -> SurfaceVotes:
    """Return the votes of a detected mask: inside for its pixels, outside for the other pixels around it.

    siblings: pixels of the frame's detections of the same noun. They never vote outside: adjacent objects of one noun
    may be one landmark.
    """
    box_px = bounding_box(mask)
    if box_px is None:
        return SurfaceVotes.empty()
    left, top, right, bottom = box_px
    margin_px = max(_MIN_MARGIN_PX, round(_MARGIN_SHARE * max(right - left, bottom - top)))
    low, high = np.array((top, left)) - margin_px, np.array((bottom, right)) + margin_px
    window = _clipped(low.astype(np.int64), high.astype(np.int64), frame)
    pixels = frame.depth_m[window].size
    points_m, is_known = window_points_m(frame, window, math.ceil(math.sqrt(pixels / _MAX_VOTING_PIXELS)))
    is_inside = mask[window][is_known]
    if siblings is not None:
        has_vote = is_inside | ~siblings[window][is_known]
        points_m, is_inside = points_m[has_vote], is_inside[has_vote]
    return SurfaceVotes.from_points(points_m, is_inside)


def mask_colours(mask: Bool[ndarray, "h w"], frame: Frame) -> Float64[ndarray, "balances ranges"]:
    """Return the `colour_counts` of a mask's pixels, without its outline, which mixes with what is behind."""
    inner = cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    pixels = frame.rgb[inner if np.count_nonzero(inner) >= _MIN_INNER_PIXELS else mask]
    return colour_counts(pixels[:: max(1, len(pixels) // _MAX_COLOUR_PIXELS)])


def surface_mask(votes: SurfaceVotes, frame: Frame) -> Bool[ndarray, "h w"]:
    """Return the pixels of a frame that show the object's surface, and gaps in depth between such pixels.

    A pixel whose depth is not that of the surface shows something in front of the object, or what is behind it. The
    outline follows the colour edges next to it.
    """
    mask = np.zeros(frame.depth_m.shape, np.bool_)
    window = _projected_window(votes, frame)
    if window is None:
        return mask
    votes = _resolved(votes, frame)
    points_m, is_known = window_points_m(frame, window)
    shown = np.zeros(is_known.shape, np.bool_)
    shown[is_known] = votes.is_on_surface(points_m)
    closed = cv2.morphologyEx(shown.astype(np.uint8), cv2.MORPH_CLOSE, _CLOSING) > 0
    mask[window] = shown | (closed & ~is_known)
    return snapped_to_edges(mask, frame.rgb)


def refined_mask(detected: Bool[ndarray, "h w"], votes: SurfaceVotes, frame: Frame) -> Bool[ndarray, "h w"]:
    """Return a detected mask with the pixels that are surely of the object, without those that are surely not.

    The detection decides where voxels inside and outside the object touch: it is finer than the voxels.
    """
    mask = detected.copy()
    box_px = bounding_box(detected)
    windows = (_projected_window(votes, frame), None if box_px is None else _box_window(box_px))
    votes = _resolved(votes, frame)
    for window in windows:
        if window is not None:
            points_m, is_known = window_points_m(frame, window)
            part = mask[window]
            part[is_known] |= votes.is_surely_inside(points_m)
            part[is_known] &= ~votes.is_surely_outside(points_m)
    return mask


def _resolved(votes: SurfaceVotes, frame: Frame) -> SurfaceVotes:
    """Return the votes in voxels that the frame resolves: of a pixel's width, and of twice its depth's deviation."""
    z_m = transform_points(inverse(frame.T_world_camera), votes.surface_m.astype(np.float64))[:, 2]
    middle_m = max(_MIN_Z_M, float(np.median(z_m))) if len(z_m) else _MIN_Z_M
    return votes.resolved(max(frame.camera.length_m(1.0, middle_m), 2.0 * depth_deviation_m(middle_m)))


def depth_deviation_m(depth_m: float) -> float:
    """Return the standard deviation of a structured-light camera's depth (Nguyen et al., 3DIMPVT 2012, Eq. 3)."""
    return 0.0012 + 0.0019 * (depth_m - 0.4) ** 2


def _box_window(box_px: tuple[float, float, float, float]) -> Window:
    left, top, right, bottom = (int(edge) for edge in box_px)
    return slice(top, bottom), slice(left, right)


def window_points_m(
    frame: Frame, window: Window, step: int = 1
) -> tuple[Float64[ndarray, "n 3"], Bool[ndarray, "h w"]]:
    """Return the world points of the window's pixels with depth, and which pixels these are.

    step: use every step-th pixel of every step-th row.
    """
    depth_m = frame.depth_m[window]
    is_known = np.zeros(depth_m.shape, np.bool_)
    is_known[::step, ::step] = depth_m[::step, ::step] > 0
    points = back_project(depth_m, frame.camera, window[1].start, window[0].start)[is_known].astype(np.float64)
    if frame.motion is not None:
        rows = np.broadcast_to(np.arange(window[0].start, window[0].stop)[:, None], is_known.shape)[is_known]
        points = frame.motion.to_middle_row(points, (rows + 0.5) / frame.camera.height_px)
    return transform_points(frame.T_world_camera, points), is_known


def _projected_window(votes: SurfaceVotes, frame: Frame) -> Window | None:
    """Return the window of a frame that contains the surface; None if it is out of view."""
    surface_m = votes.surface_m[:: -(-len(votes.surface_m) // _MAX_PROJECTED) or 1].astype(np.float64)
    points = transform_points(inverse(frame.T_world_camera), surface_m)
    points = points[points[:, 2] > _MIN_Z_M].astype(np.float32)
    if len(points) == 0:
        return None
    pixels = np.floor(project(points, frame.camera)[:, ::-1]).astype(np.int64)
    window = _clipped(pixels.min(axis=0) - _MIN_MARGIN_PX, pixels.max(axis=0) + _MIN_MARGIN_PX, frame)
    is_empty = any(side.stop <= side.start for side in window)
    return None if is_empty else window


def _clipped(low: ndarray, high: ndarray, frame: Frame) -> Window:
    """Return the window between two corners (row, column) inside the frame."""
    shape = frame.depth_m.shape
    (top, left), (bottom, right) = np.clip(low, 0, shape).tolist(), np.clip(high, 0, shape).tolist()
    return slice(top, bottom), slice(left, right)
