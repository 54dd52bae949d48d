"""Tell from a recording itself how wrong its poses and colours are: frames that see the same surfaces should agree.

A frame is carried into another by its depth and both poses, as far from it in time as both still show the same, and
fitted there as a map's drawing is. Where poses are exact and exposure is fixed nothing has to move; the motions and
colour changes that are needed instead are the errors of two views together.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import cv2
import numpy as np
from numpy import ndarray

from gausslite.calibration.exposure import fit_exposure
from gausslite.calibration.pose_exposure_prior import HANDHELD_PRIOR, PoseExposurePrior
from gausslite.calibration.pose_fit import fit_pose, twist_of
from gausslite.calibration.view_residuals import MAX_RELATIVE_DEPTH_ERROR, comparable_pixels
from gausslite.datasets.registered_source import register_depth
from gausslite.datasets.selection import downscaled_size
from gausslite.datasets.source import Source
from gausslite.domain.camera import back_project
from gausslite.domain.frame import Frame
from gausslite.domain.pose import inverse, transform_points
from gausslite.errors import DatasetError, PoseError
from gausslite.render.rasterizer import NEAR_M, Rendering

_SPOTS = 24
_FEWEST_PAIRS = 4
_FEWEST_PIXELS = 2000
"""About a quarter of the image: less says too little to tell a pose by."""
_EXACT_M, _EXACT_DEG = 0.003, 0.1
"""Simulated homes, whose poses are exact, seem to err by up to 2 mm and 0.05 degrees."""


def estimate_pose_exposure_prior(source: Source) -> tuple[PoseExposurePrior, str]:
    """How wrong the source's views are, all trusted where poses are exact as far as this can tell; and why.

    Frames that cannot be read are passed over: who maps them is told then.
    """
    motions, gains, offsets = [], [], []
    for drawn, frame in _pairs(source):
        fitted = fit_pose(drawn, inverse(frame.T_world_camera), frame, HANDHELD_PRIOR)
        colour = fit_exposure(drawn, frame, HANDHELD_PRIOR)
        motions.append(twist_of(inverse(frame.T_world_camera) @ fitted))
        gains.append(colour.gain - 1.0)
        offsets.append(colour.offset)
    if len(motions) < _FEWEST_PAIRS:
        return PoseExposurePrior(), f"{len(motions)} pairs of its frames can be compared, too few to tell"
    moved = np.array(motions)
    found = PoseExposurePrior(
        translation_m=round(_of_one_view(moved[:, :3]), 3),
        rotation_deg=round(math.degrees(_of_one_view(moved[:, 3:])), 2),
        gain=round(_of_one_view(np.array(gains)), 2),
        offset=round(_of_one_view(np.array(offsets)), 2),
    )
    why = f"{len(motions)} pairs of its frames agree to {1e3 * found.translation_m:.0f} mm, {found.rotation_deg:g} deg"
    exact = found.translation_m <= _EXACT_M and found.rotation_deg <= _EXACT_DEG
    return (PoseExposurePrior() if exact else found), why


def _of_one_view(between_two: ndarray) -> float:
    """The standard deviation of one view's error from those between two; single wild fits do not count."""
    return float(1.4826 * np.median(np.abs(between_two)) / math.sqrt(2.0))


def _pairs(source: Source) -> Iterator[tuple[Rendering, Frame]]:
    """Frames, and what another one says they should look like; spread over the source, and far apart in time."""
    count, size = len(source), downscaled_size(source.camera)
    reach = count // 4
    for position in sorted({round(spot) for spot in np.linspace(0, count - 1, _SPOTS)}):
        towards_middle = 1 if position < count // 2 else -1
        gap = min(2 * reach, count // 2)
        while gap >= 1:
            try:
                first = source.frame(position, size)
                second = source.frame(position + towards_middle * gap, size)
            except (DatasetError, PoseError):
                break
            drawn = _carried(first, second)
            if len(comparable_pixels(drawn, second)) >= _FEWEST_PIXELS:
                yield drawn, second
                reach = gap
                break
            gap //= 2


def _carried(frame: Frame, other: Frame) -> Rendering:
    """The frame as the other's camera would have seen it, by the depth and poses that were said."""
    T_other_frame = inverse(other.T_world_camera) @ frame.T_world_camera
    depth_m = register_depth(frame.depth_m, frame.camera, other.camera, T_other_frame)
    points = transform_points(inverse(T_other_frame), back_project(depth_m, other.camera).reshape(-1, 3))
    z_m = np.maximum(points[:, 2], NEAR_M)
    # remap counts pixel centres at integers
    columns = (points[:, 0] / z_m * frame.camera.fx_px + frame.camera.cx_px - 0.5).astype(np.float32)
    rows = (points[:, 1] / z_m * frame.camera.fy_px + frame.camera.cy_px - 0.5).astype(np.float32)
    at = columns.reshape(depth_m.shape), rows.reshape(depth_m.shape)
    rgb = cv2.remap(frame.rgb, *at, cv2.INTER_LINEAR).astype(np.float32) / np.float32(255.0)
    behind_m = np.abs(cv2.remap(frame.depth_m, *at, cv2.INTER_NEAREST) - z_m.reshape(depth_m.shape))
    alpha = ((depth_m > 0) & (behind_m < MAX_RELATIVE_DEPTH_ERROR * depth_m)).astype(np.float32)
    return Rendering(rgb, depth_m * alpha, alpha, None)
