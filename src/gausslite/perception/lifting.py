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
from gausslite.domain.pose import transform_points, unit_up_axis
from gausslite.domain.relevance import Detection
from gausslite.nouns import is_convex
from gausslite.perception.object_map import Observation
from gausslite.perception.settings import LiftingSettings, RelevanceTrackerSettings
from gausslite.perception.surface import mask_colours, mask_votes

# percentiles of a plane's points: the outermost points of a mask are often of other things
_INNER_PERCENTILES = (10.0, 90.0)


def best_depth_m(
    sensor_m: Float32[ndarray, "h w"], rendered_m: Float32[ndarray, "h w"] | None
) -> Float32[ndarray, "h w"]:
    """Return the rendered depth where the map is not empty, the sensor's depth elsewhere."""
    if rendered_m is None or rendered_m.shape != sensor_m.shape:
        return sensor_m
    return np.where(rendered_m > 0, rendered_m, sensor_m)


def lift_detections(
    detections: Sequence[Detection], depth_m: Float32[ndarray, "h w"], frame: Frame, settings: RelevanceTrackerSettings
) -> list[tuple[Detection, Observation]]:
    """Return the detections with improved masks and their observations in the world.

    Those with too little depth are left out, and those of a kind that is not convex but show one plane, such as a rug
    or a screen.
    """
    improved = [
        replace(detection, mask=_object_mask(detection, depth_m, frame.camera, settings.lifting))
        for detection in detections
    ]
    of_noun: dict[str, Bool[ndarray, "h w"]] = {}
    for detection in improved:
        if not detection.is_weak:
            of_noun[detection.phrase] = of_noun.get(detection.phrase, False) | detection.mask
    lifted = []
    for detection in improved:
        own_pixels = _own_pixels(detection, of_noun, settings.lifting)
        observation = _lift(detection, depth_m, frame, of_noun.get(detection.phrase), own_pixels, settings)
        if observation is not None:
            lifted.append((detection, observation))
    return lifted


def _object_mask(
    detection: Detection, depth_m: Float32[ndarray, "h w"], camera: Camera, settings: LiftingSettings
) -> Bool[ndarray, "h w"]:
    """Return a detection's mask in its depth layer: filled if its kind is convex, else without background planes.

    An exact mask is not filled: in the demo, the vote's region would lose 0.7 dB.
    """
    mask = foreground_mask(detection.mask, depth_m, settings)
    if is_convex(detection.phrase):
        return mask if detection.is_exact else filled_outline(mask, depth_m, settings)
    return without_background_planes(mask, depth_m, camera, settings)


def _lift(
    detection: Detection,
    depth_m: Float32[ndarray, "h w"],
    frame: Frame,
    siblings: Bool[ndarray, "h w"] | None,
    own_pixels: Bool[ndarray, "h w"],
    settings: RelevanceTrackerSettings,
) -> Observation | None:
    """Lift a detection's mask to an observation in the world; None if too few pixels have depth, or for a plane.

    The paper lifts the pixel at the 2D centroid, which may lie outside the object; this lifts all pixels.
    siblings: pixels of the frame's detections of the same noun. own_pixels: the part of the mask that locates the
    object. A weak detection has no votes and colours.
    """
    rows, columns = np.nonzero(own_pixels & (depth_m > 0))
    if len(rows) < settings.lifting.min_pixels:
        return None
    step = max(1, len(rows) // settings.lifting.max_pixels)
    rows, columns = rows[::step], columns[::step]
    centres_px = np.stack([columns, rows], axis=1) + 0.5
    points = lift(centres_px, depth_m[rows, columns].astype(np.float64), frame.camera)
    if frame.motion is not None:
        points = frame.motion.to_middle_row(points, (rows + 0.5) / frame.camera.height_px)
    points_m = transform_points(frame.T_world_camera, points)
    observation = Observation.from_points(
        detection.phrase,
        points_m,
        frame.T_world_camera[:3, 3],
        detection.score,
        frame.capture_time_ns,
        settings.object_map,
    )
    if not is_convex(detection.phrase):
        plane = FittedPlane.of(observation.without_outliers(points_m))
        if plane.is_level_or_upright(np.array(unit_up_axis(settings.up_axis)), settings.lifting):
            return None
    if detection.is_weak:
        return replace(observation, rival=detection.rival, is_weak=True)
    votes = mask_votes(detection.mask, frame, settings.surface, siblings)
    colours = mask_colours(detection.mask, frame, settings.surface)
    return replace(observation, rival=detection.rival, votes=votes, colours=colours)


def _own_pixels(
    detection: Detection, of_noun: Mapping[str, Bool[ndarray, "h w"]], settings: LiftingSettings
) -> Bool[ndarray, "h w"]:
    """Return the mask's pixels that no other noun claims, or all if those are less than half.

    The mask of a chair spills over to the leg of a table beside it, and would locate the chair at the table.
    """
    own = detection.mask.copy()
    for noun, claimed in of_noun.items():
        if noun != detection.phrase:
            own &= ~claimed
    has_enough = np.count_nonzero(own) >= settings.min_own_share * np.count_nonzero(detection.mask)
    return own if has_enough else detection.mask


def foreground_mask(
    mask: Bool[ndarray, "h w"], depth_m: Float32[ndarray, "h w"], settings: LiftingSettings
) -> Bool[ndarray, "h w"]:
    """Return the nearest layer of depth with enough of the mask, between almost empty bins; unmeasured pixels stay."""
    known = mask & (depth_m > 0)
    log_depths = np.log(depth_m[known])
    if len(log_depths) < settings.min_pixels:
        return mask
    bins = ((log_depths - log_depths.min()) / settings.depth_bin_share).astype(np.int64)
    counts = np.bincount(bins)
    almost_empty = max(settings.min_bin_share * len(bins), settings.min_bin_to_peak * float(counts.max()))
    filled = np.flatnonzero(counts > almost_empty)
    layer = np.cumsum(np.diff(filled, prepend=filled[0]) > settings.gap_bins)
    shares = np.bincount(layer, weights=counts[filled]) / len(bins)
    nearest = filled[layer == np.flatnonzero(shares >= min(settings.min_layer_share, shares.max()))[0]]
    front = mask.copy()
    front[known] = (bins >= nearest[0] - 1) & (bins <= nearest[-1] + 1)
    return front


def filled_outline(
    mask: Bool[ndarray, "h w"], depth_m: Float32[ndarray, "h w"], settings: LiftingSettings
) -> Bool[ndarray, "h w"]:
    """Return a mask with the pixels of its depth inside its convex outline: detectors leave out a bowl's fruit."""
    known = depth_m[mask & (depth_m > 0)]
    if len(known) == 0:
        return mask
    rows, columns = np.nonzero(mask)
    outline = cv2.convexHull(np.stack([columns, rows], axis=1).astype(np.int32))
    hull = cv2.fillConvexPoly(np.zeros(mask.shape, np.uint8), outline, 1) > 0
    nearest_m, farthest_m = np.percentile(known, (settings.outer_percent, 100.0 - settings.outer_percent))
    slack_m = settings.depth_slack_m
    added = hull & ~mask & (depth_m >= nearest_m - slack_m) & (depth_m <= farthest_m + slack_m)
    wide = np.ones((settings.min_added_px, settings.min_added_px), np.uint8)
    filled: Bool[ndarray, "h w"] = mask | (cv2.morphologyEx(added.astype(np.uint8), cv2.MORPH_OPEN, wide) > 0)
    return filled


def without_background_planes(
    mask: Bool[ndarray, "h w"], depth_m: Float32[ndarray, "h w"], camera: Camera, settings: LiftingSettings
) -> Bool[ndarray, "h w"]:
    """Return the mask without pixels on planes that also surround it, such as the wall behind or the floor below it.

    Depth has no clear gap there. A plane has a fifth of the points in a ring around the mask. If planes have more than
    four fifths of the mask, the mask is unchanged: then the object is flat itself.
    """
    if not mask.any():
        return mask
    rows, columns = np.nonzero(mask)
    margin_px = settings.ring_outer_px
    window = (
        slice(max(0, int(rows.min()) - margin_px), int(rows.max()) + 1 + margin_px),
        slice(max(0, int(columns.min()) - margin_px), int(columns.max()) + 1 + margin_px),
    )
    inside, depths_m = mask[window], depth_m[window]
    points_m = back_project(depths_m, camera, window[1].start, window[0].start).astype(np.float64)
    limits_m = np.maximum(settings.plane_distance_m, settings.plane_distance_share * depths_m)
    left = inside.copy()
    for plane in _planes(points_m[_ring(inside, settings) & (depths_m > 0)], settings):
        left &= (depths_m == 0) | (np.abs(points_m @ plane[:3] - plane[3]) > limits_m)
    if np.count_nonzero(left) < settings.min_left_share * np.count_nonzero(inside):
        return mask
    out = mask.copy()
    out[window] = left
    return out


def _ring(inside: Bool[ndarray, "h w"], settings: LiftingSettings) -> Bool[ndarray, "h w"]:
    """Return the pixels near a mask, without its outline, whose depth is often between both surfaces."""
    near, outline = (
        cv2.dilate(inside.astype(np.uint8), np.ones((2 * margin_px + 1, 2 * margin_px + 1), np.uint8)) > 0
        for margin_px in (settings.ring_outer_px, settings.ring_inner_px)
    )
    ring: Bool[ndarray, "h w"] = near & ~outline
    return ring


def _planes(points_m: Float64[ndarray, "n 3"], settings: LiftingSettings) -> list[Float64[ndarray, "4"]]:
    """Return unit normals and offsets of some planes, the largest first; each from random triples of points."""
    points_m = points_m[:: max(1, len(points_m) // settings.max_ring_points)]
    min_points = max(settings.min_ring_points, round(settings.min_plane_share * len(points_m)))
    rng = np.random.default_rng(0)
    planes: list[Float64[ndarray, "4"]] = []
    while len(planes) < settings.max_planes and len(points_m) >= min_points:
        corners = points_m[rng.integers(len(points_m), size=(settings.plane_samples, 3))]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        lengths = np.linalg.norm(normals, axis=1, keepdims=True)
        normals = np.divide(normals, lengths, out=np.zeros_like(normals), where=lengths > 0)
        offsets_m = np.einsum("ij,ij->i", normals, corners[:, 0])
        limits_m = np.maximum(settings.plane_distance_m, settings.plane_distance_share * points_m[:, 2])
        is_near = (np.abs(points_m @ normals.T - offsets_m) < limits_m[:, None]) & (lengths[:, 0] > 0)
        best = int(is_near.sum(axis=0).argmax())
        if np.count_nonzero(is_near[:, best]) < min_points:
            break
        planes.append(np.append(normals[best], offsets_m[best]))
        points_m = points_m[~is_near[:, best]]
    return planes


@dataclass(frozen=True, slots=True, eq=False)
class FittedPlane:
    """A plane through points: its unit normal, the extent of the points in it, and their thickness across it."""

    normal: Float64[ndarray, "3"]
    extent_m: float
    thickness_m: float

    @classmethod
    def of(cls, points_m: Float64[ndarray, "n 3"]) -> FittedPlane:
        """Return the plane through the centroid of at least one point that has the least squared distances.

        Extent and thickness are without the outer tenths of the points on both sides.
        """
        offsets_m = points_m - points_m.mean(axis=0)
        _, axes = np.linalg.eigh(offsets_m.T @ offsets_m)
        sides_m = np.ptp(np.percentile(offsets_m @ axes, _INNER_PERCENTILES, axis=0), axis=0)
        return cls(axes[:, 0], float(np.hypot(sides_m[1], sides_m[2])), float(sides_m[0]))

    def is_level_or_upright(self, up: Float64[ndarray, "3"], settings: LiftingSettings) -> bool:
        """Return True if the points are thin, and level as those of a rug or upright as those of a screen."""
        is_thin = self.thickness_m <= settings.max_plane_thickness_share * self.extent_m
        rise = abs(float(self.normal @ up))
        lean = min(rise, float(np.sqrt(max(0.0, 1.0 - rise * rise))))
        return is_thin and self.extent_m >= settings.min_plane_extent_m and lean <= settings.max_plane_lean_share
