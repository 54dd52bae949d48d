"""Fit the exposure of a photograph to a rendering of the map: gain and offset of each channel, under a prior."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Float32, Float64, Shaped, UInt8
from numpy import ndarray

from gausslite.domain.frame import Frame
from gausslite.domain.recording import PoseExposurePrior
from gausslite.render.rasterizer import Rendering
from gausslite_poses.least_squares import NormalEquations, robust_weights, shrinkage
from gausslite_poses.photometric import MAX_PIXELS, MIN_PIXELS, comparable_pixels, independent_share

_BLUR_PX = 15
_FIT_GAIN_STD, _FIT_OFFSET_STD = 0.05, 0.015
"""Error of the fit itself on a map that still grows, measured where exposure is fixed."""


@dataclass(frozen=True, slots=True, eq=False)
class AffineExposure:
    """photograph = gain · map + offset in each channel, for colours in [0, 1]."""

    gain: Float64[ndarray, "3"]
    offset: Float64[ndarray, "3"]

    def to_photograph(self, rendered_rgb: Float[ndarray, "h w 3"]) -> Float32[ndarray, "h w 3"]:
        """Return rendered colours as the photograph shows them, clipped to [0, 1]."""
        rgb: Float32[ndarray, "h w 3"] = np.clip(rendered_rgb * self.gain + self.offset, 0.0, 1.0).astype(np.float32)
        return rgb

    def to_map(self, rgb: UInt8[ndarray, "h w 3"]) -> UInt8[ndarray, "h w 3"]:
        """Return a photograph in the map's colours, rounded to 8 bits."""
        value = np.arange(256)[:, None] / 255.0
        table = np.clip((value - self.offset) / self.gain, 0.0, 1.0)
        map_rgb: UInt8[ndarray, "h w 3"] = cv2.LUT(rgb, np.rint(table * 255.0).astype(np.uint8)[:, None, :])
        return map_rgb


IDENTITY_EXPOSURE = AffineExposure(np.ones(3), np.zeros(3))


def fit_exposure(
    rendering: Rendering, frame: Frame, prior: PoseExposurePrior, max_pixels: int = MAX_PIXELS
) -> AffineExposure:
    """Return the exposure that brings the rendering closest to the frame where the map covers the image.

    Returns IDENTITY_EXPOSURE if the prior allows no exposure error or fewer than 200 pixels are comparable.
    """
    pixels = comparable_pixels(rendering, frame, max_pixels)
    if not prior.has_exposure_error or len(pixels) < MIN_PIXELS:
        return IDENTITY_EXPOSURE
    # without the blur, detail of the photograph that the map lacks would pull the gain below 1
    model = _blurred(rendering.rgb)[pixels].astype(np.float64)
    residual = _blurred(frame.rgb)[pixels] / 255.0 - model
    prior_std, gain, offset = np.array([prior.gain, prior.offset]), np.ones(3), np.zeros(3)
    for channel in range(3):
        # of the residual: photograph - (gain * rendering + offset)
        jacobian = -np.stack([model[:, channel], np.ones(len(model))], axis=1)
        weights = independent_share(rendering, max_pixels) * robust_weights(residual[:, channel])
        change = NormalEquations.of(jacobian, residual[:, channel], weights).solve(np.zeros(2), prior_std)
        # shrinkage beside the prior: a map that still grows has errors of its own, and must not drift with them
        gain[channel] += change[0] * shrinkage(prior.gain, _FIT_GAIN_STD)
        offset[channel] += change[1] * shrinkage(prior.offset, _FIT_OFFSET_STD)
    return AffineExposure(gain, offset)


def _blurred(image: Shaped[ndarray, "h w 3"]) -> Float32[ndarray, "n 3"]:
    blurred: Float32[ndarray, "n 3"] = cv2.boxFilter(image, cv2.CV_32F, (_BLUR_PX, _BLUR_PX)).reshape(-1, 3)
    return blurred
