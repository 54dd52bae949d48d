"""Remove what shows between the leaves of a plant or the legs of a seat, where depth has no clear gap."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64
from numpy import ndarray

from gausslite.domain.camera import Camera, back_project
from gausslite.domain.object_names import is_plant, is_seat

_RING_PX: Final = (2, 9)
_MAX_PLANES: Final = 3
_SAMPLES: Final = 64
_MAX_RING_POINTS: Final = 600
_MIN_RING_POINTS: Final = 30
_MIN_PLANE_SHARE: Final = 0.2
_MIN_DISTANCE_M: Final = 0.015
_DISTANCE_SHARE: Final = 0.01
_MIN_LEFT_SHARE: Final = 0.2


def without_background_planes(
    phrase: str, mask: Bool[ndarray, "h w"], depth_m: Float32[ndarray, "h w"], camera: Camera
) -> Bool[ndarray, "h w"]:
    """Return the mask of a plant or seat without pixels on planes that also surround it; other masks unchanged.

    A plane has a fifth of the points in a ring around the mask. If it has more than four fifths of the mask, the mask
    is unchanged: then the plane is the object.
    """
    if not (is_plant(phrase) or is_seat(phrase)) or not mask.any():
        return mask
    rows, columns = np.nonzero(mask)
    margin_px = _RING_PX[1]
    window = (
        slice(max(0, int(rows.min()) - margin_px), int(rows.max()) + 1 + margin_px),
        slice(max(0, int(columns.min()) - margin_px), int(columns.max()) + 1 + margin_px),
    )
    inside, depths_m = mask[window], depth_m[window]
    points_m = back_project(depths_m, camera, window[1].start, window[0].start).astype(np.float64)
    left = inside.copy()
    for plane in _planes(points_m[_ring(inside) & (depths_m > 0)]):
        distances_m = np.abs(points_m @ plane[:3] - plane[3])
        left &= (depths_m == 0) | (distances_m > np.maximum(_MIN_DISTANCE_M, _DISTANCE_SHARE * depths_m))
    if np.count_nonzero(left) < _MIN_LEFT_SHARE * np.count_nonzero(inside):
        return mask
    out = mask.copy()
    out[window] = left
    return out


def _ring(inside: Bool[ndarray, "h w"]) -> Bool[ndarray, "h w"]:
    """Return the pixels near a mask, without its outline, whose depth is often between both surfaces."""
    near, outline = (
        cv2.dilate(inside.astype(np.uint8), np.ones((2 * margin + 1, 2 * margin + 1), np.uint8)) > 0
        for margin in reversed(_RING_PX)
    )
    ring: Bool[ndarray, "h w"] = near & ~outline
    return ring


def _planes(points_m: Float64[ndarray, "n 3"]) -> list[Float64[ndarray, "4"]]:
    """Return unit normals and offsets of up to three planes, the largest first; each from random triples of points."""
    points_m = points_m[:: max(1, len(points_m) // _MAX_RING_POINTS)]
    min_points = max(_MIN_RING_POINTS, round(_MIN_PLANE_SHARE * len(points_m)))
    rng = np.random.default_rng(0)
    planes: list[Float64[ndarray, "4"]] = []
    while len(planes) < _MAX_PLANES and len(points_m) >= min_points:
        corners = points_m[rng.integers(len(points_m), size=(_SAMPLES, 3))]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        lengths = np.linalg.norm(normals, axis=1, keepdims=True)
        normals = np.divide(normals, lengths, out=np.zeros_like(normals), where=lengths > 0)
        offsets_m = np.einsum("ij,ij->i", normals, corners[:, 0])
        limits_m = np.maximum(_MIN_DISTANCE_M, _DISTANCE_SHARE * points_m[:, 2])
        is_near = (np.abs(points_m @ normals.T - offsets_m) < limits_m[:, None]) & (lengths[:, 0] > 0)
        best = int(is_near.sum(axis=0).argmax())
        if np.count_nonzero(is_near[:, best]) < min_points:
            break
        planes.append(np.append(normals[best], offsets_m[best]))
        points_m = points_m[~is_near[:, best]]
    return planes
