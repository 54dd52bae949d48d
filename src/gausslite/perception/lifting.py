"""Lift a frame's detections into the world: masks of one depth layer with what containers hold, their points, votes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float32
from numpy import ndarray

from gausslite.domain.camera import lift
from gausslite.domain.frame import Frame
from gausslite.domain.pose import transform_points
from gausslite.domain.relevance import Detection
from gausslite.perception.background_planes import without_background_planes
from gausslite.perception.contents import with_contents
from gausslite.perception.foreground import foreground_mask
from gausslite.perception.object_map import Observation
from gausslite.perception.object_masks import mask_colours, mask_votes

_MIN_PIXELS = 8
_MAX_PIXELS = 4000
_MIN_OWN_SHARE = 0.5


def best_depth_m(
    sensor_m: Float32[ndarray, "h w"], rendered_m: Float32[ndarray, "h w"] | None
) -> Float32[ndarray, "h w"]:
    """Return the rendered depth where the map is not empty, the sensor's depth elsewhere."""
    if rendered_m is None or rendered_m.shape != sensor_m.shape:
        return sensor_m
    return np.where(rendered_m > 0, rendered_m, sensor_m)


def lift_observation(
    detection: Detection,
    depth_m: Float32[ndarray, "h w"],
    frame: Frame,
    siblings: Bool[ndarray, "h w"] | None,
    own_pixels: Bool[ndarray, "h w"],
) -> Observation | None:
    """Lift a detection's mask to an observation in the world; None if too few of its pixels have depth.

    The paper lifts the pixel at the 2D centroid, which may lie outside the object; this lifts all pixels.
    siblings: pixels of the frame's detections of the same noun. own_pixels: the part of the mask that locates the
    object. A weak detection has no votes and colours.
    """
    rows, columns = np.nonzero(own_pixels & (depth_m > 0))
    if len(rows) < _MIN_PIXELS:
        return None
    step = max(1, len(rows) // _MAX_PIXELS)
    rows, columns = rows[::step], columns[::step]
    centres_px = np.stack([columns, rows], axis=1) + 0.5
    points = lift(centres_px, depth_m[rows, columns].astype(np.float64), frame.camera)
    if frame.motion is not None:
        points = frame.motion.to_middle_row(points, (rows + 0.5) / frame.camera.height_px)
    T_world_camera = frame.T_world_camera
    points_m = transform_points(T_world_camera, points)
    camera_m, time_ns = T_world_camera[:3, 3], frame.capture_time_ns
    observation = Observation.from_points(detection.phrase, points_m, camera_m, detection.score, time_ns)
    if detection.is_weak:
        return replace(observation, rival=detection.rival, is_weak=True)
    votes, colours = mask_votes(detection.mask, frame, siblings), mask_colours(detection.mask, frame)
    return replace(observation, rival=detection.rival, votes=votes, colours=colours)


def lift_detections(
    detections: Sequence[Detection], depth_m: Float32[ndarray, "h w"], frame: Frame
) -> list[tuple[Detection, Observation]]:
    """Return the detections with improved masks and their observations, without those that have too little depth."""
    improved = [replace(each, mask=_improved_mask(each, depth_m, frame)) for each in detections]
    of_noun: dict[str, Bool[ndarray, "h w"]] = {}
    for each in improved:
        if not each.is_weak:
            of_noun[each.phrase] = of_noun.get(each.phrase, False) | each.mask
    lifted = [
        (each, lift_observation(each, depth_m, frame, of_noun.get(each.phrase), _own_pixels(each, of_noun)))
        for each in improved
    ]
    return [(detection, observation) for detection, observation in lifted if observation is not None]


def _own_pixels(detection: Detection, of_noun: Mapping[str, Bool[ndarray, "h w"]]) -> Bool[ndarray, "h w"]:
    """Return the mask's pixels that no other noun claims, or all if those are less than half.

    The mask of a chair spills over to the leg of a table beside it, and would locate the chair at the table.
    """
    own = detection.mask.copy()
    for noun, claimed in of_noun.items():
        if noun != detection.phrase:
            own &= ~claimed
    return own if np.count_nonzero(own) >= _MIN_OWN_SHARE * np.count_nonzero(detection.mask) else detection.mask


def _improved_mask(detection: Detection, depth_m: Float32[ndarray, "h w"], frame: Frame) -> Bool[ndarray, "h w"]:
    mask = foreground_mask(detection.mask, depth_m)
    mask = without_background_planes(detection.phrase, mask, depth_m, frame.camera)
    return with_contents(detection.phrase, mask, depth_m)
