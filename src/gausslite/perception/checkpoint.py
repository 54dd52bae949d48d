"""Encode landmarks as named arrays, and decode them to resume in another process."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gausslite.domain.errors import MapFileError
from gausslite.domain.state import State, encode_text, get_array, get_counts, get_floats, get_text, int_array
from gausslite.perception.colours import no_colours
from gausslite.perception.object_map import MAX_SUPPORTS, Landmark
from gausslite.perception.supporting_surface import FloorLevel
from gausslite.perception.surface_votes import VOXEL_SIZES_M, SurfaceVotes


def encode_landmark(landmark: Landmark) -> dict[str, NDArray[Any]]:
    """Encode a landmark."""
    return {
        "phrase": encode_text(landmark.phrase),
        "centroid_radius_m": np.array([*landmark.centroid_m, landmark.radius_m]),
        "cells": landmark.cells,
        "counts": landmark.counts,
        "seen_missed": int_array(landmark.seen_count, landmark.missed_count, landmark.missed_in_a_row),
        "weak_count": int_array(landmark.weak_count),
        "seen_ns_number": np.array([landmark.first_seen_ns, landmark.last_seen_ns, landmark.number], np.int64),
        "best_score_farthest_m": np.array([landmark.best_score, landmark.farthest_m]),
        "rival_names": encode_text("\n".join(landmark.rival_scores)),
        "vote_keys": landmark.votes.keys,
        "votes": np.stack([landmark.votes.inside, landmark.votes.outside]),
        "vote_voxel_m": np.array([landmark.votes.voxel_m]),
        "colours": landmark.colours,
        "supports_m": landmark.supports_m,
        "score_sums": np.array([landmark.score_sum, *landmark.rival_scores.values()]),
    }


def decode_landmark(state: State) -> Landmark:
    """Decode a landmark. Raises MapFileError, InvalidInputError."""
    x_m, y_m, z_m, radius_m = get_floats(state, "centroid_radius_m", 4)
    cells = get_array(state, "cells", (None,), np.int64).copy()
    counts = get_array(state, "counts", cells.shape, np.int64).copy()
    if (counts < 1).any() or (cells[1:] <= cells[:-1]).any() or len(cells) == 0:
        raise MapFileError("state landmark: expected ascending cells with positive counts, got others")
    seen_count, missed_count, missed_in_a_row = get_counts(state, "seen_missed", 3)
    (weak_count,) = get_counts(state, "weak_count", 1)
    best_score, farthest_m = get_floats(state, "best_score_farthest_m", 2)
    extent = (get_text(state, "phrase"), np.array([x_m, y_m, z_m]), radius_m, cells, counts)
    first_ns, last_ns, number = (int(value) for value in get_array(state, "seen_ns_number", (3,), np.int64))
    keys = get_array(state, "vote_keys", (None,), np.int64).copy()
    inside, outside = get_array(state, "votes", (2, len(keys)), np.int64).copy()
    if (keys[1:] <= keys[:-1]).any() or (inside < 0).any() or (outside < 0).any():
        raise MapFileError("state landmark: expected ascending voxels with votes, got others")
    (voxel_m,) = get_floats(state, "vote_voxel_m", 1)
    if voxel_m not in VOXEL_SIZES_M:
        raise MapFileError(f"state landmark: expected voxels of {', '.join(map(str, VOXEL_SIZES_M))} m, got {voxel_m}")
    votes = SurfaceVotes(keys, inside, outside, voxel_m)
    colours = get_array(state, "colours", no_colours().shape, np.float64).copy()
    if not np.isfinite(colours).all() or (colours < 0).any():
        raise MapFileError("state landmark: expected colours of zero or more, got others")
    supports_m = get_array(state, "supports_m", (None,), np.float64).copy()
    if len(supports_m) > MAX_SUPPORTS or not np.isfinite(supports_m).all():
        raise MapFileError(f"state landmark: expected at most {MAX_SUPPORTS} finite levels, got {len(supports_m)}")
    names = get_text(state, "rival_names").splitlines()
    score_sum, *rival_sums = get_floats(state, "score_sums", 1 + len(names))
    rivals = dict(zip(names, rival_sums, strict=True))
    landmark = Landmark(*extent, seen_count, missed_count, best_score, farthest_m, first_ns, last_ns, number)
    scored = replace(landmark, score_sum=score_sum, rival_scores=rivals)
    seen = replace(scored, votes=votes, colours=colours, supports_m=supports_m)
    return replace(seen, missed_in_a_row=missed_in_a_row, weak_count=weak_count)


def decode_floor(state: State) -> FloorLevel:
    """Decode the observed heights. Raises MapFileError."""
    empty = FloorLevel.before_frames()
    counts = get_array(state, "floor_counts", empty.counts.shape, np.int64).copy()
    levels_m = get_array(state, "first_camera_m", (None,), np.float64)
    if (counts < 0).any() or len(levels_m) > 1 or not np.isfinite(levels_m).all():
        raise MapFileError("state floor: expected counts of zero or more and at most one finite level, got others")
    return FloorLevel(float(levels_m[0]) if len(levels_m) else None, counts)
