"""Compare the luminance of a rendering and a photograph, and linearise the difference by the pose."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, UInt8
from numpy import ndarray

from gausslite.domain.camera import Camera
from gausslite.domain.frame import Frame
from gausslite.render.rasterizer import NEAR_M, Rendering

_LUMINANCE = np.array([0.299, 0.587, 0.114], np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class LuminancePair:
    """Blurred luminance: the map's at the compared pixels, and the photograph's with its x and y gradients."""

    model: Float64[ndarray, " n"]
    photograph: Float32[ndarray, "h w 3"]

    @classmethod
    def of(cls, rendering: Rendering, frame: Frame, pixels: Int64[ndarray, " n"], blur_px: float) -> LuminancePair:
        """Return the pair of a rendering and the frame that it shows, at these flat pixel indices."""
        model = cv2.GaussianBlur(rendering.rgb @ _LUMINANCE, (0, 0), blur_px)
        photograph = with_gradients(blurred_luminance(frame.rgb, blur_px))
        return cls(model.ravel()[pixels].astype(np.float64), photograph)


@dataclass(frozen=True, slots=True, eq=False)
class Linearisation:
    """Residual photograph - model and its Jacobian by twist, gain and offset, of the points inside the image.

    pixels: where the photograph shows each point, (column, row) from pixel centres at integers.
    """

    jacobian: Float64[ndarray, "m 8"]
    residual: Float64[ndarray, " m"]
    is_inside: Bool[ndarray, " n"]
    pixels: Float32[ndarray, "m 1 2"]


def blurred_luminance(rgb: UInt8[ndarray, "h w 3"], blur_px: float) -> Float32[ndarray, "h w"]:
    """Return the luminance from 0 to 1, blurred by a Gaussian of this deviation."""
    luminance: Float32[ndarray, "h w"] = cv2.GaussianBlur(rgb @ (_LUMINANCE / np.float32(255.0)), (0, 0), blur_px)
    return luminance


def with_gradients(luminance: Float32[ndarray, "h w"]) -> Float32[ndarray, "h w 3"]:
    """Return the luminance with its derivatives by x and y, per pixel."""
    dx = cv2.Sobel(luminance, cv2.CV_32F, 1, 0, ksize=3, scale=0.125)
    dy = cv2.Sobel(luminance, cv2.CV_32F, 0, 1, ksize=3, scale=0.125)
    return np.stack([luminance, dx, dy], axis=2)


def linearise(
    images: LuminancePair,
    points: Float32[ndarray, "n 3"],
    T_camera_rendered: Float64[ndarray, "4 4"],
    camera: Camera,
) -> Linearisation:
    """Return the residual and Jacobian of the points, given in the rendered view, as the camera sees them."""
    moved = points.astype(np.float64) @ T_camera_rendered[:3, :3].T + T_camera_rendered[:3, 3]
    depth = np.maximum(moved[:, 2], NEAR_M)
    # cv2.remap places pixel centres at integers
    u = camera.fx_px * moved[:, 0] / depth + camera.cx_px - 0.5
    v = camera.fy_px * moved[:, 1] / depth + camera.cy_px - 0.5
    inside = (u >= 1) & (v >= 1) & (u <= camera.width_px - 2) & (v <= camera.height_px - 2) & (moved[:, 2] > NEAR_M)
    x, y, z = moved[inside].T
    model = images.model[inside]
    pixels = np.stack([u[inside], v[inside]], axis=1).astype(np.float32)[:, None]
    sampled = sample_bilinear(images.photograph, pixels)
    by_x, by_y = sampled[:, 1] * camera.fx_px / z, sampled[:, 2] * camera.fy_px / z
    by_z = -(by_x * x + by_y * y) / z
    rotation = [by_z * y - by_y * z, by_x * z - by_z * x, by_y * x - by_x * y]
    jacobian = np.stack([by_x, by_y, by_z, *rotation, -model, -np.ones_like(model)], axis=1)
    return Linearisation(jacobian, sampled[:, 0] - model, inside, pixels)


def sample_bilinear(image: Float32[ndarray, "h w c"], pixels: Float32[ndarray, "n 1 2"]) -> Float64[ndarray, "n c"]:
    """Return bilinear values at (column, row). cv2.remap takes at most 32767 points, more than `comparable_pixels`."""
    columns, rows = np.ascontiguousarray(pixels[..., 0]), np.ascontiguousarray(pixels[..., 1])
    sampled = cv2.remap(image, columns, rows, cv2.INTER_LINEAR).reshape(len(pixels), -1)
    return sampled.astype(np.float64)
