"""Lift a frame's detections into the world: masks without what is behind the object, their points and votes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64
from numpy import ndarray

from gausslite.domain.camera import Camera, back_project, lift
from gausslite.domain.frame import Frame
from gausslite.domain.pose import transform_points
from gausslite.domain.relevance import Detection
from gausslite.nouns import is_convex
from gausslite.perception.object_map import Observation
from gausslite.perception.surface import is_off_planes, mask_votes, window_around

_MIN_PIXELS = 8
"""Pixels with depth that an observation needs."""
_MAX_PIXELS = 4000
"""Pixels that are lifted of a larger mask."""
_MIN_OWN_SHARE = 0.5
"""Share of a mask that no other noun claims, from which these pixels alone locate the object."""
_DEPTH_BIN_SHARE = 0.02
"""Width of a bin of depths: the noise of a depth camera at 4 m. With one layer, chairs' IoU is 0.70 (0.63)."""
_GAP_BINS = 2
"""Almost empty bins that separate two layers."""
_MIN_BIN_SHARE = 0.005
"""Share of the mask below which a bin is almost empty."""
_MIN_BIN_TO_PEAK = 0.05
"""Share of the fullest bin below which a bin is almost empty."""
_MIN_LAYER_SHARE = 0.15
"""Share of the mask from which the nearest layer is the object."""
_OUTER_PERCENT = 2.0
"""Pixels with the least and the largest depth, in percent, that do not count to the depth of a convex object."""
_DEPTH_SLACK_M = 0.03
"""Distance from that depth within which pixels inside the outline belong to the object. Without them, the recall of
a bowl with fruit is 0.52 instead of 0.94, and of the kitchen's table 0.80 instead of 0.88."""
_MIN_ADDED_PX = 3
"""Width from which they are more than the steps of an outline. With 5, the bowl's recall is 0.89."""
_RING_INNER_PX = 2
"""Pixels next to the outline that show no plane: their depth is often between two surfaces."""
_RING_OUTER_PX = 9
"""Width of the ring around a mask in which planes are searched."""
_PLANE_DISTANCE_M = 0.015
_PLANE_DISTANCE_SHARE = 0.01
"""Distance within which points are on a plane, in metres and as a share of depth; the larger one counts."""
_MIN_PLANE_EXTENT_M = 0.25
"""Extent from which a plane can be seen to be one."""
_MAX_PLANE_THICKNESS_SHARE = 0.06
"""Thickness of a plane relative to its extent. Seats seen from behind have 0.06 or more, or lean 7 degrees."""
_MAX_PLANE_LEAN_SHARE = 0.1
"""Sine of the angle by which a level or upright plane leans."""

# percentiles of a plane's points: the outermost points of a mask are often of other things
_INNER_PERCENTILES = (10.0, 90.0)


def best_depth_m(frame: Frame, rendered_m: Float32[ndarray, "h w"] | None) -> Float32[ndarray, "h w"]:
    """Return the rendered depth where the map is not empty, the sensor's depth elsewhere and in what is left out."""
    if rendered_m is None or rendered_m.shape != frame.depth_m.shape:
        return frame.depth_m
    is_rendered = rendered_m > 0 if frame.left_out is None else (rendered_m > 0) & ~frame.left_out
    return np.where(is_rendered, rendered_m, frame.depth_m)


def lift_detections(
    detections: Sequence[Detection], depth_m: Float32[ndarray, "h w"], frame: Frame, up: Float64[ndarray, "3"]
) -> list[tuple[Detection, Observation]]:
    """Return the detections with improved masks and their observations in the world.

    Those with too little depth are left out, and those of a kind that is not convex but show one plane, such as a rug
    or a screen.
    """
    improved = [replace(detection, mask=_object_mask(detection, depth_m, frame.camera)) for detection in detections]
    of_noun: dict[str, Bool[ndarray, "h w"]] = {}
    for detection in improved:
        if not detection.is_weak:
            of_noun[detection.phrase] = of_noun.get(detection.phrase, False) | detection.mask
    lifted = []
    for detection in improved:
        own_pixels = _own_pixels(detection, of_noun)
        observation = _lift(detection, depth_m, frame, of_noun.get(detection.phrase), own_pixels, up)
        if observation is not None:
            lifted.append((detection, observation))
    return lifted


def _object_mask(detection: Detection, depth_m: Float32[ndarray, "h w"], camera: Camera) -> Bool[ndarray, "h w"]:
    """Return a detection's mask in its depth layer: filled if its kind is convex, else without background planes.

    An exact mask is not filled: in the demo, the vote's region would lose 0.7 dB.
    """
    mask = foreground_mask(detection.mask, depth_m)  # a box of a chair shows the wall behind it too
    if is_convex(detection.phrase):
        return mask if detection.is_exact else filled_outline(mask, depth_m)
    return without_background_planes(mask, depth_m, camera)


def _lift(
    detection: Detection,
    depth_m: Float32[ndarray, "h w"],
    frame: Frame,
    siblings: Bool[ndarray, "h w"] | None,
    own_pixels: Bool[ndarray, "h w"],
    up: Float64[ndarray, "3"],
) -> Observation | None:
    """Lift a detection's mask to an observation in the world; None if too few pixels have depth, or for a plane.

    The paper lifts the pixel at the 2D centroid, which may lie outside the object; this lifts all pixels.
    siblings: pixels of the frame's detections of the same noun. own_pixels: the part of the mask that locates the
    object. A weak detection has no votes.
    """
    rows, columns = np.nonzero(own_pixels & (depth_m > 0))
    if len(rows) < _MIN_PIXELS:
        return None
    step = max(1, len(rows) // _MAX_PIXELS)  # the median of a part is as good
    rows, columns = rows[::step], columns[::step]
    centres_px = np.stack([columns, rows], axis=1) + 0.5
    points = lift(centres_px, depth_m[rows, columns].astype(np.float64), frame.camera)
    if frame.motion is not None:
        points = frame.motion.to_middle_row(points, (rows + 0.5) / frame.camera.height_px)
    points_m = transform_points(frame.T_world_camera, points)
    observation = Observation.from_points(
        detection.phrase, points_m, frame.T_world_camera[:3, 3], detection.score, frame.capture_time_ns
    )
    own_m = observation.without_outliers(points_m)
    if not is_convex(detection.phrase) and FittedPlane.of(own_m).is_level_or_upright(up):
        return None
    if detection.is_weak:
        return replace(observation, rival=detection.rival, is_weak=True)
    return replace(observation, rival=detection.rival, votes=mask_votes(detection.mask, frame, siblings))


def _own_pixels(detection: Detection, of_noun: Mapping[str, Bool[ndarray, "h w"]]) -> Bool[ndarray, "h w"]:
    """Return the mask's pixels that no other noun claims, or all if those are less than half.

    The mask of a chair spills over to the leg of a table beside it, and would locate the chair at the table.
    """
    own = detection.mask.copy()
    for noun, claimed in of_noun.items():
        if noun != detection.phrase:
            own &= ~claimed
    return own if np.count_nonzero(own) >= _MIN_OWN_SHARE * np.count_nonzero(detection.mask) else detection.mask


def foreground_mask(mask: Bool[ndarray, "h w"], depth_m: Float32[ndarray, "h w"]) -> Bool[ndarray, "h w"]:
    """Return the nearest layer of depth with enough of the mask, between almost empty bins; unmeasured pixels stay."""
    known = mask & (depth_m > 0)
    log_depths = np.log(depth_m[known])  # noise grows with the depth
    if len(log_depths) < _MIN_PIXELS:
        return mask
    bins = ((log_depths - log_depths.min()) / _DEPTH_BIN_SHARE).astype(np.int64)
    counts = np.bincount(bins)
    almost_empty = max(_MIN_BIN_SHARE * len(bins), _MIN_BIN_TO_PEAK * float(counts.max()))
    filled = np.flatnonzero(counts > almost_empty)
    layer = np.cumsum(np.diff(filled, prepend=filled[0]) > _GAP_BINS)  # a gap in depth separates object and background
    shares = np.bincount(layer, weights=counts[filled]) / len(bins)
    nearest = filled[layer == np.flatnonzero(shares >= min(_MIN_LAYER_SHARE, shares.max()))[0]]
    front = mask.copy()
    front[known] = (bins >= nearest[0] - 1) & (bins <= nearest[-1] + 1)
    return front


def filled_outline(mask: Bool[ndarray, "h w"], depth_m: Float32[ndarray, "h w"]) -> Bool[ndarray, "h w"]:
    """Return a mask with the pixels of its depth inside its convex outline: detectors leave out a bowl's fruit."""
    known = depth_m[mask & (depth_m > 0)]
    if len(known) == 0:
        return mask
    rows, columns = np.nonzero(mask)
    outline = cv2.convexHull(np.stack([columns, rows], axis=1).astype(np.int32))
    hull = cv2.fillConvexPoly(np.zeros(mask.shape, np.uint8), outline, 1) > 0
    nearest_m, farthest_m = np.percentile(known, (_OUTER_PERCENT, 100.0 - _OUTER_PERCENT))
    # in the outline, at the depth of the object
    added = hull & ~mask & (depth_m >= nearest_m - _DEPTH_SLACK_M) & (depth_m <= farthest_m + _DEPTH_SLACK_M)
    wide = np.ones((_MIN_ADDED_PX, _MIN_ADDED_PX), np.uint8)
    filled: Bool[ndarray, "h w"] = mask | (cv2.morphologyEx(added.astype(np.uint8), cv2.MORPH_OPEN, wide) > 0)
    return filled


def without_background_planes(
    mask: Bool[ndarray, "h w"], depth_m: Float32[ndarray, "h w"], camera: Camera
) -> Bool[ndarray, "h w"]:
    """Return the mask without pixels on planes that also surround it, such as the wall behind or the floor below it.

    Depth has no clear gap there. If planes have four fifths of the mask, it is unchanged: the object is flat itself.
    """
    window = window_around(mask, _RING_OUTER_PX)
    if window is None:
        return mask
    inside, depths_m = mask[window], depth_m[window]
    points_m = back_project(depths_m, camera, window[1].start, window[0].start).astype(np.float64)
    limits_m = np.where(depths_m > 0, np.maximum(_PLANE_DISTANCE_M, _PLANE_DISTANCE_SHARE * depths_m), -1.0)
    ring = _ring(inside) & (depths_m > 0)
    out = mask.copy()
    out[window][inside] = is_off_planes(points_m[inside], limits_m[inside], points_m[ring], limits_m[ring])
    return out


def _ring(inside: Bool[ndarray, "h w"]) -> Bool[ndarray, "h w"]:
    """Return the pixels near a mask, without its outline, whose depth is often between both surfaces."""
    near, outline = (
        cv2.dilate(inside.astype(np.uint8), np.ones((2 * margin_px + 1, 2 * margin_px + 1), np.uint8)) > 0
        for margin_px in (_RING_OUTER_PX, _RING_INNER_PX)
    )
    ring: Bool[ndarray, "h w"] = near & ~outline
    return ring


@dataclass(frozen=True, slots=True, eq=False)
class FittedPlane:
    """A plane through points: its unit normal, the extent of the points in it, and their thickness across it."""

    normal: Float64[ndarray, "3"]
    extent_m: float
    thickness_m: float  # across the plane

    @classmethod
    def of(cls, points_m: Float64[ndarray, "n 3"]) -> FittedPlane:
        """Return the plane through the centroid of at least one point that has the least squared distances.

        Extent and thickness are without the outer tenths of the points on both sides.
        """
        offsets_m = points_m - points_m.mean(axis=0)
        _, axes = np.linalg.eigh(offsets_m.T @ offsets_m)
        sides_m = np.ptp(np.percentile(offsets_m @ axes, _INNER_PERCENTILES, axis=0), axis=0)
        return cls(axes[:, 0], float(np.hypot(sides_m[1], sides_m[2])), float(sides_m[0]))

    def is_level_or_upright(self, up: Float64[ndarray, "3"]) -> bool:
        """Return True if the points are thin, and level as those of a rug or upright as those of a screen."""
        is_thin = self.thickness_m <= _MAX_PLANE_THICKNESS_SHARE * self.extent_m
        rise = abs(float(self.normal @ up))
        lean = min(rise, float(np.sqrt(max(0.0, 1.0 - rise * rise))))
        return is_thin and self.extent_m >= _MIN_PLANE_EXTENT_M and lean <= _MAX_PLANE_LEAN_SHARE
