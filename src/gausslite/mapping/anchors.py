"""Move the Gaussians with the keyframes that they are anchored to, when the poses of keyframes are corrected.

A Gaussian's mean and rotation move rigidly with its anchor, and so does their average (EMA). Adam's state follows: a
gradient by the mean rotates with the mean, one by the quaternion with the quaternion; second moments, which are the
diagonal of a covariance, take the squares of the rotation's entries. Scales, opacity, colour, kappa, activity and
evidence do not depend on a direction and stay.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32, Float64
from numpy import ndarray

from gausslite.domain.gaussians import left_product
from gausslite.mapping.splat_table import NO_ANCHOR, SplatTable
from gausslite.render.rasterizer import MEAN, QUAT

_LEAST_MOTION = 1e-9
"""Motions below this, in metres and in entries of the rotation, are rounding errors."""


def move_with_anchors(table: SplatTable, T_corrected_earlier: Float64[ndarray, "k 4 4"]) -> int:
    """Move the Gaussians of each keyframe by its motion, given by keyframe number; return how many Gaussians moved."""
    moved = np.abs(T_corrected_earlier - np.eye(4)).max(axis=(1, 2), initial=0.0) > _LEAST_MOTION
    anchored = np.flatnonzero(table.anchor != NO_ANCHOR)
    ids = anchored[moved[table.anchor[anchored]]]
    ids = ids[np.argsort(table.anchor[ids], kind="stable")]
    anchors, first = np.unique(table.anchor[ids], return_index=True)
    blocks = [slice(start, end) for start, end in itertools.pairwise((*first.tolist(), len(ids)))]
    R = T_corrected_earlier[anchors, :3, :3]
    L = np.array([left_product(rotation) for rotation in R]).reshape(-1, 4, 4)
    t = T_corrected_earlier[anchors, :3, 3]
    for rows in (table.rows, table.ema_rows):
        rows[ids] = _multiplied(rows.take(ids, axis=0), blocks, R, L, t)
    for moments, power in ((table.first_moment, 1), (table.second_moment, 2)):
        moments[ids] = _multiplied(moments.take(ids, axis=0), blocks, R**power, L**power, np.zeros_like(t))
    return len(ids)


def _multiplied(
    rows: Float32[ndarray, "n 16"],
    blocks: Sequence[slice],
    R: Float64[ndarray, "k 3 3"],
    L: Float64[ndarray, "k 4 4"],
    t: Float64[ndarray, "k 3"],
) -> Float32[ndarray, "n 16"]:
    """Return the rows with mean R · mean + t and quaternion L · quaternion; each block has its own R, L and t."""
    for block, rotation, product, translation in zip(blocks, R, L, t, strict=True):
        rows[block, MEAN] = rows[block, MEAN] @ rotation.T + translation
        rows[block, QUAT] = rows[block, QUAT] @ product.T
    return rows
