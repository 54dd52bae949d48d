"""Encode landmarks and propagated detections as named arrays, and decode them to resume in another process."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from gausslite.domain.camera import Camera
from gausslite.domain.errors import MapFileError
from gausslite.domain.pose import require_rigid
from gausslite.domain.relevance import Detection
from gausslite.domain.state import State, encode_text, get_array, get_counts, get_floats, get_text, int_array
from gausslite.perception.object_map import Landmark
from gausslite.perception.reproject import Frustum


def encode_frustum(frustum: Frustum) -> dict[str, NDArray[Any]]:
    """Encode a propagated detection and its camera."""
    detection, camera = frustum.detection, frustum.camera
    intrinsics = (camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px)
    return {
        "phrase": encode_text(detection.phrase),
        "mask": detection.mask,
        "numbers": np.array([detection.score, *detection.box_px, *intrinsics, frustum.near_m, frustum.far_m]),
        "T_world_camera": frustum.T_world_camera,
        "missed_detections": int_array(frustum.missed_detections),
    }


def decode_frustum(state: State) -> Frustum:
    """Decode a propagated detection. Raises MapFileError, InvalidInputError."""
    numbers = get_floats(state, "numbers", 11)
    score, left, top, right, bottom, fx_px, fy_px, cx_px, cy_px, near_m, far_m = numbers
    mask = get_array(state, "mask", (None, None), np.bool_).copy()
    T_world_camera = get_array(state, "T_world_camera", (4, 4), np.float64).copy()
    require_rigid("state T_world_camera", T_world_camera)
    detection = Detection(get_text(state, "phrase"), score, (left, top, right, bottom), mask)
    camera = Camera(fx_px, fy_px, cx_px, cy_px, mask.shape[1], mask.shape[0])
    [missed_detections] = get_counts(state, "missed_detections", 1)
    return Frustum(detection, camera, T_world_camera, near_m, far_m, missed_detections)


def encode_landmark(landmark: Landmark) -> dict[str, NDArray[Any]]:
    """Encode a landmark."""
    return {
        "phrase": encode_text(landmark.phrase),
        "centroid_radius_m": np.array([*landmark.centroid_m, landmark.radius_m]),
        "cells": landmark.cells,
        "counts": landmark.counts,
        "seen_missed": int_array(landmark.seen_count, landmark.missed_count),
        "seen_ns_number": np.array([landmark.first_seen_ns, landmark.last_seen_ns, landmark.number], np.int64),
        "best_score_farthest_m": np.array([landmark.best_score, landmark.farthest_m]),
        "rival_names": encode_text("\n".join(landmark.rival_scores)),
        "score_sums": np.array([landmark.score_sum, *landmark.rival_scores.values()]),
    }


def decode_landmark(state: State) -> Landmark:
    """Decode a landmark. Raises MapFileError, InvalidInputError."""
    x_m, y_m, z_m, radius_m = get_floats(state, "centroid_radius_m", 4)
    cells = get_array(state, "cells", (None,), np.int64).copy()
    counts = get_array(state, "counts", cells.shape, np.int64).copy()
    if (counts < 1).any() or (cells[1:] <= cells[:-1]).any() or len(cells) == 0:
        raise MapFileError("state landmark: expected ascending cells with positive counts, got others")
    seen_count, missed_count = get_counts(state, "seen_missed", 2)
    best_score, farthest_m = get_floats(state, "best_score_farthest_m", 2)
    extent = (get_text(state, "phrase"), np.array([x_m, y_m, z_m]), radius_m, cells, counts)
    first_ns, last_ns, number = (int(value) for value in get_array(state, "seen_ns_number", (3,), np.int64))
    names = get_text(state, "rival_names").splitlines()
    score_sum, *rival_sums = get_floats(state, "score_sums", 1 + len(names))
    rivals = dict(zip(names, rival_sums, strict=True))
    return Landmark(
        *extent, seen_count, missed_count, best_score, farthest_m, first_ns, last_ns, number, score_sum, rivals
    )
