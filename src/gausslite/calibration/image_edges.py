"""Edges of depth images as points, and gradients of colour images relative to their surroundings."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8
from numpy import ndarray

from gausslite.domain.camera import lift
from gausslite.domain.frame import Frame

_JUMP_M, _JUMP_SHARE = 0.06, 0.05
_MAX_GAP_PX = 16
_LOCAL_MEAN_PX = 12.0
_GRADIENT_FLOOR, _MAX_RELATIVE_GRADIENT = 2.0, 4.0


@dataclass(frozen=True, slots=True, eq=False)
class DepthEdges:
    """Points in the depth camera's frame, on the near side of depth jumps along rows and along columns of one image."""

    along_rows: Float64[ndarray, "n 3"]
    along_columns: Float64[ndarray, "m 3"]

    def thinned(self, every: int) -> DepthEdges:
        """Return every `every`th point."""
        return DepthEdges(self.along_rows[::every], self.along_columns[::every])


@dataclass(frozen=True, slots=True, eq=False)
class ColourGradients:
    """Gradient of one colour image along rows and along columns, relative to its local mean."""

    along_rows: Float32[ndarray, "h w"]
    along_columns: Float32[ndarray, "h w"]


def depth_edges(frame: Frame) -> DepthEdges:
    """Return points on pixel borders where depth jumps, at the smaller of both depths."""
    rows, columns, z_m = _jumps(frame.depth_m)
    along_rows = lift(np.stack([columns + 1.0, rows + 0.5], axis=1), z_m, frame.camera)
    columns, rows, z_m = _jumps(np.ascontiguousarray(frame.depth_m.T))
    return DepthEdges(along_rows, lift(np.stack([columns + 0.5, rows + 1.0], axis=1), z_m, frame.camera))


def _jumps(depth_m: Float32[ndarray, "h w"]) -> tuple[ndarray, ndarray, Float64[ndarray, " n"]]:
    """Return row and column of each pixel before a jump along its row, and the smaller depth."""
    filled = _fill_occlusions(depth_m)
    nearer = np.minimum(filled[:, :-1], filled[:, 1:])
    jump_m = np.abs(filled[:, 1:] - filled[:, :-1])
    rows, columns = np.nonzero((nearer > 0) & (jump_m > np.maximum(_JUMP_M, _JUMP_SHARE * nearer)))
    return rows, columns, nearer[rows, columns].astype(np.float64)


def _fill_occlusions(depth_m: Float32[ndarray, "h w"]) -> Float32[ndarray, "h w"]:
    """Fill short gaps in a row with the larger depth at their ends: sensors have none next to occluding edges."""
    width = depth_m.shape[1]
    valid: Bool[ndarray, "h w"] = depth_m > 0
    columns = np.arange(width)
    before = np.maximum.accumulate(np.where(valid, columns, -width), axis=1)
    after = np.minimum.accumulate(np.where(valid, columns, 2 * width)[:, ::-1], axis=1)[:, ::-1]
    ends = [np.take_along_axis(depth_m, np.clip(end, 0, width - 1), axis=1) for end in (before, after)]
    return np.where(~valid & (after - before <= _MAX_GAP_PX), np.maximum(*ends), depth_m)


def relative_gradients(rgb: UInt8[ndarray, "h w 3"], blur_px: float) -> ColourGradients:
    """Return the gradients of an image that is blurred by a Gaussian of this width."""
    grey = cv2.GaussianBlur(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32), (0, 0), blur_px)
    return ColourGradients(_relative_gradient(grey, 1, 0), _relative_gradient(grey, 0, 1))


def _relative_gradient(grey: Float32[ndarray, "h w"], dx: int, dy: int) -> Float32[ndarray, "h w"]:
    """Return the gradient relative to its local mean, so that one high-contrast object does not dominate."""
    gradient = np.abs(cv2.Sobel(grey, cv2.CV_32F, dx, dy, ksize=3))
    local_mean = cv2.GaussianBlur(gradient, (0, 0), _LOCAL_MEAN_PX)
    relative: Float32[ndarray, "h w"] = np.minimum(
        gradient / (local_mean + np.float32(_GRADIENT_FLOOR)), np.float32(_MAX_RELATIVE_GRADIENT)
    )
    return relative
