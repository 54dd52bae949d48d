"""Verify a camera pose in a map by rendering it: refine it, then compare with the image and with displaced poses.

Two questions decide. The pose must be a sharp optimum: from each of twelve displaced poses, the residual of colour and
depth is larger by four of its standard errors. And the map must show the same place: depth agrees, and so do the
texture inside small cells, the colours and their layout over the image, whatever the exposure. A look-alike passes the
first and fails the second.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, Num
from numpy import ndarray

from gausslite.domain.camera import Camera, CameraMotion
from gausslite.domain.frame import Frame
from gausslite.domain.pose import orthonormal, transform_of
from gausslite.render.rasterizer import Rendering
from gausslite_poses.photometric import COARSE_TO_FINE, FINE, align

RenderMap = Callable[[Camera, Float64[ndarray, "4 4"], CameraMotion | None], Rendering]
"""Renders a map from T_world_camera."""

_WIDTH_PX = 160
_PRIOR_STD = np.array([0.1] * 3 + [np.radians(5.0)] * 3)
"""Error of a registered pose: translation (m) and rotation (rad)."""
_OPAQUE_ALPHA = 0.7
_LUMINANCE = np.array([0.299, 0.587, 0.114], np.float32) / np.float32(255.0)
_MAX_DEPTH_SHARE, _MAX_LUMINANCE = 0.1, 0.25
"""Residuals saturate here: relative depth, and luminance after the images' common offset."""
_DISPLACED_M, _DISPLACED_RAD = 0.15, np.radians(8.0)
_BLUR_PX = 1.0
_CELL_PX = 16
_MIN_CELL_PX = 32
_MIN_CELLS = 8
_MIN_COVERED = 0.3
_SIGMAS = 4.0
_MIN_AGREEMENT, _MIN_TEXTURE, _MAX_CHROMA = 0.7, 0.65, 8.0
"""Of 58 mirrored views, four of a simulated home passed all other tests, with textures of 0.53 to 0.60 and chroma of 12
to 13; right poses in that home have at least 0.79 and at most 6."""
_MIN_LAYOUT, _FLAT_CHROMA = 0.8, 2.0
"""A symmetric cupboard with a television, mirrored, has textures of 0.73 to 0.83 and chroma of 7.0 to 7.7, which right
poses have too, but layouts of at most 0.73; of 55 right poses in that home and in the kitchen, the least is 0.86."""

_SPREAD, _CHROMA_SPREAD = 0.15, 2.0
"""By which texture and layout, and chroma, differ between two maps of one place."""


@dataclass(frozen=True, slots=True, eq=False)
class Verification:
    """A refined pose, and what the map's rendering says about it.

    covered: share of the image's measured pixels where the map is opaque. agreement: share of these whose depth agrees
    within 10 %. texture: correlation of the luminance inside cells of 16 pixels. chroma: mean difference of Lab's a and
    b after a common offset. layout: correlation of the cells' mean a, or b, the lower one. sigmas: by how many standard
    errors the residual of the best displaced pose is larger.
    """

    T_world_camera: Float64[ndarray, "4 4"]
    covered: float
    agreement: float = 0.0
    texture: float = 0.0
    chroma: float = np.inf
    layout: float = 0.0
    sigmas: float = 0.0

    @property
    def is_accepted(self) -> bool:
        """True if the map covers the view, agrees with it, and no displaced pose agrees as well."""
        return self.shows_the_same and self.sigmas >= _SIGMAS

    @property
    def shows_the_same(self) -> bool:
        """True if the map covers the view, and depth, texture and colours agree."""
        colours_agree = self.chroma <= _MAX_CHROMA and self.layout >= _MIN_LAYOUT
        return self.depth_agrees and self.texture >= _MIN_TEXTURE and colours_agree

    def is_about_as_good(self, best: Verification) -> bool:
        """True if the map shows the image here too, or nearly as well as at the best pose."""
        colours_agree = self.chroma <= best.chroma + _CHROMA_SPREAD and self.layout >= best.layout - _SPREAD
        return self.shows_the_same or (self.depth_agrees and self.texture >= best.texture - _SPREAD and colours_agree)

    @property
    def depth_agrees(self) -> bool:
        """True if the map covers the view, and its depth agrees."""
        return self.covered >= _MIN_COVERED and self.agreement >= _MIN_AGREEMENT


@dataclass(frozen=True, slots=True, eq=False)
class _Residuals:
    """Residuals of each pixel as shares of their limits; rendered: luminance. compared: pixels of both images."""

    depth: Float32[ndarray, "h w"]
    luminance: Float32[ndarray, "h w"]
    rendered: Float32[ndarray, "h w"]
    compared: Bool[ndarray, "h w"]

    @property
    def mean(self) -> Float32[ndarray, "h w"]:
        """Mean of both residuals of each pixel."""
        mean: Float32[ndarray, "h w"] = 0.5 * (self.depth + self.luminance)
        return mean

    @classmethod
    def of(cls, rendering: Rendering, photograph: Frame) -> _Residuals:
        compared = (rendering.alpha > _OPAQUE_ALPHA) & (photograph.depth_m > 0)
        rendered_m = rendering.depth_m / np.maximum(rendering.alpha, np.float32(_OPAQUE_ALPHA))
        limit_m = np.maximum(np.float32(_MAX_DEPTH_SHARE) * photograph.depth_m, np.float32(1e-3))
        rendered, recorded = (
            blurred_luminance(rgb) for rgb in (np.float32(255.0) * np.clip(rendering.rgb, 0.0, 1.0), photograph.rgb)
        )
        difference = rendered - recorded
        if compared.any():
            difference -= np.median(difference[compared])  # exposures differ
        return cls(
            np.minimum(np.abs(rendered_m - photograph.depth_m) / limit_m, np.float32(1.0)),
            np.minimum(np.abs(difference) / np.float32(_MAX_LUMINANCE), np.float32(1.0)),
            rendered,
            compared,
        )


def verify(render: RenderMap, frame: Frame, T_world_camera: Float64[ndarray, "4 4"]) -> Verification:
    """Return the pose refined to the map, and how the map agrees with the frame there.

    T_world_camera: within about 10 cm and 5 degrees; the frame's own pose is not used.
    """
    photograph = reduced(frame)
    T, rendering = _refined(render, photograph, T_world_camera)
    found = _Residuals.of(rendering, photograph)
    measured = int(np.count_nonzero(photograph.depth_m > 0))
    covered = int(np.count_nonzero(found.compared)) / max(measured, 1)
    if covered < _MIN_COVERED:
        return Verification(T, covered)
    agreement = float((found.depth[found.compared] < 1.0).mean())
    texture = texture_correlation(found.rendered, blurred_luminance(photograph.rgb), found.compared)
    chroma, layout = _compare_colours(rendering, photograph, found.compared)
    verification = Verification(T, covered, agreement, texture, chroma, layout)
    if not verification.shows_the_same:
        return verification
    sigmas = min(
        _sigmas(found, _Residuals.of(render(photograph.camera, T @ displacement, None), photograph))
        for displacement in _displacements()
    )
    return replace(verification, sigmas=sigmas)


def reduced(frame: Frame, width_px: int = _WIDTH_PX) -> Frame:
    """Return the frame at most this wide, with the camera at rest."""
    camera = frame.camera.narrower(width_px)
    size = camera.width_px, camera.height_px
    rgb = cv2.resize(frame.rgb, size, interpolation=cv2.INTER_AREA)
    depth_m = cv2.resize(frame.depth_m, size, interpolation=cv2.INTER_NEAREST)
    return replace(frame, rgb=rgb, depth_m=depth_m, camera=camera, motion=None, recorded_rgb=None, left_out=None)


def _refined(
    render: RenderMap, photograph: Frame, T_world_camera: Float64[ndarray, "4 4"]
) -> tuple[Float64[ndarray, "4 4"], Rendering]:
    """Return the pose aligned to the map, and the map's rendering from it; the given pose if they do not align."""
    rendering = render(photograph.camera, T_world_camera, None)
    for levels in (COARSE_TO_FINE, FINE):
        aligned = align(rendering, T_world_camera, photograph, _PRIOR_STD, levels)
        if aligned is None:
            break
        T_world_camera = orthonormal(aligned.T_world_camera)
        rendering = render(photograph.camera, T_world_camera, None)
    return T_world_camera, rendering


def blurred_luminance(rgb: Num[ndarray, "h w 3"]) -> Float32[ndarray, "h w"]:
    """Return the luminance of colours from 0 to 255, from 0 to 1, as `texture_correlation` compares it."""
    blurred: Float32[ndarray, "h w"] = cv2.GaussianBlur(rgb @ _LUMINANCE, (0, 0), _BLUR_PX)
    return blurred


def texture_correlation(
    rendered: Float32[ndarray, "h w"], recorded: Float32[ndarray, "h w"], pixels: Bool[ndarray, "h w"]
) -> float:
    """Return the correlation of two luminances about their means in each cell, over these pixels."""
    compared = pixels.astype(np.float32)
    counts = _cell_sums(compared)
    enough = counts >= _MIN_CELL_PX

    def covariance(a: Float32[ndarray, "h w"], b: Float32[ndarray, "h w"]) -> float:
        sums = _cell_sums(a * b * compared) - _cell_sums(a * compared) * _cell_sums(b * compared) / np.maximum(
            counts, 1.0
        )
        return float(sums[enough].sum())

    spread = covariance(recorded, recorded) * covariance(rendered, rendered)
    return covariance(recorded, rendered) / float(np.sqrt(max(spread, 1e-12)))


def _compare_colours(rendering: Rendering, photograph: Frame, compared: Bool[ndarray, "h w"]) -> tuple[float, float]:
    """Return chroma, after the median difference because white balances differ, and layout."""
    images = np.clip(rendering.rgb, 0.0, 1.0), photograph.rgb.astype(np.float32) / np.float32(255.0)
    rendered, recorded = (cv2.cvtColor(image, cv2.COLOR_RGB2LAB)[..., 1:] for image in images)
    difference = (rendered - recorded)[compared]
    chroma = float(np.linalg.norm(difference - np.median(difference, axis=0), axis=1).mean())
    counts = _cell_sums(compared.astype(np.float32))
    enough = counts >= _MIN_CELL_PX
    if np.count_nonzero(enough) < _MIN_CELLS:
        return chroma, 0.0
    layouts = []
    for i in range(2):
        sums = (_cell_sums(lab[..., i] * compared)[enough] for lab in (rendered, recorded))
        (a, both), (_, b) = np.cov([total / counts[enough] for total in sums], ddof=0) + _FLAT_CHROMA**2
        layouts.append(float(both / np.sqrt(a * b)))  # of flat colours, which correlate by chance, 1
    return chroma, min(layouts)


def _displacements() -> list[Float64[ndarray, "4 4"]]:
    """Return motions of the camera by 15 cm along, and by 8 degrees about, each axis in both directions."""
    sizes = [_DISPLACED_M] * 3 + [_DISPLACED_RAD] * 3
    return [transform_of(sign * size * axis) for size, axis in zip(sizes, np.eye(6), strict=True) for sign in (-1, 1)]


def _sigmas(found: _Residuals, displaced: _Residuals) -> float:
    """Return by how many standard errors the displaced residual is larger; neighbours err together, so cells count."""
    both = found.compared & displaced.compared
    difference = np.where(both, displaced.mean - found.mean, np.float32(0.0))
    cells = [_cell_sums(image) for image in (difference, both.astype(np.float32))]
    enough = cells[1] >= _MIN_CELL_PX
    if np.count_nonzero(enough) < _MIN_CELLS:
        return 0.0
    means = cells[0][enough] / cells[1][enough]
    return float(means.mean() / max(means.std(ddof=1) / np.sqrt(len(means)), 1e-6))


def _cell_sums(image: Float32[ndarray, "h w"]) -> Float64[ndarray, "ch cw"]:
    rows, columns = (np.arange(0, side, _CELL_PX) for side in image.shape)
    return np.add.reduceat(np.add.reduceat(image.astype(np.float64), rows, 0), columns, 1)
