"""Render a finished map from any pose, and score it on held-out views, also after fitting their pose and exposure.

Poses of real cameras have errors and exposures differ between frames. Without fitting, a sharp map rendered from a
slightly wrong pose scores below a blurred map. The raw score includes pose errors; the fitted score measures the map.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float64
from numpy import ndarray

from gausslite.domain.arrays import require_array
from gausslite.domain.camera import Camera, CameraMotion
from gausslite.domain.frame import Frame
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.pose import inverse
from gausslite.domain.recording import HANDHELD_PRIOR, PoseExposurePrior
from gausslite.domain.relevance import Region
from gausslite.pose_fit.exposure import fit_exposure
from gausslite.pose_fit.photometric import fit_pose
from gausslite.render.choose import choose_rasterizer
from gausslite.render.rasterizer import Rasterizer, Rendering, gaussians_to_rows

MIN_ROI_PIXELS = 64
"""Views with fewer region pixels are not scored inside the region."""


@dataclass(frozen=True, slots=True, eq=False)
class HeldOutView:
    """A frame that no map was trained on, and the mask of the task's region."""

    frame: Frame
    roi: Bool[ndarray, "h w"]

    def __post_init__(self) -> None:
        require_array("view roi", self.roi, self.frame.depth_m.shape, np.bool_)

    @classmethod
    def of(cls, frame: Frame, regions: Iterable[Region]) -> HeldOutView:
        """Return the frame with the union of these regions' masks."""
        roi = np.zeros(frame.depth_m.shape, np.bool_)
        for region in regions:
            roi |= region.mask(frame)
        return cls(frame, roi)

    @property
    def shows_region(self) -> bool:
        """True if the view shows at least MIN_ROI_PIXELS of the region."""
        return int(np.count_nonzero(self.roi)) >= MIN_ROI_PIXELS


def largest_roi_views(views: Sequence[HeldOutView], count: int) -> set[int]:
    """Return the positions of the views with the largest region in each of `count` segments of the sequence."""
    return largest_roi_per_segment([int(np.count_nonzero(view.roi)) for view in views], count)


def largest_roi_per_segment(roi_pixels: Sequence[int], count: int) -> set[int]:
    """Return the place of the largest region in each of `count` segments; of small ones only if all are small."""
    if count < 1:
        return set()
    pixels = np.array(roi_pixels)
    segments = [part for part in np.array_split(np.arange(len(pixels)), count) if len(part)]
    best = {int(part[np.argmax(pixels[part])]) for part in segments}
    return {i for i in best if pixels[i] >= MIN_ROI_PIXELS} or best


class MapViewer:
    """Renders one map from many poses; converts it to splat rows once. It owns neither the map nor the rasterizer."""

    def __init__(self, gaussians: Gaussians, rasterizer: Rasterizer) -> None:
        self._rows = gaussians_to_rows(gaussians)
        self._rasterizer = rasterizer

    def render(
        self, camera: Camera, T_world_camera: Float64[ndarray, "4 4"], motion: CameraMotion | None = None
    ) -> Rendering:
        """Return the map's rendering from this camera pose; colours are clipped to [0, 1]. Raises ShapeError."""
        rendering = self._rasterizer.forward(self._rows, camera, inverse(T_world_camera), motion=motion)
        # copies: a backend may reuse its images for the next rendering
        return Rendering(np.clip(rendering.rgb, 0.0, 1.0), rendering.depth_m.copy(), rendering.alpha.copy(), None)

    def render_frame(self, frame: Frame) -> Rendering:
        """Return the map's rendering from the frame's camera pose, with the frame's motion."""
        return self.render(frame.camera, frame.T_world_camera, frame.motion)


def view_map(gaussians: Gaussians, backend: str = "auto", threads: int | None = None) -> MapViewer:
    """Return a viewer with a rasterizer of its own, see `choose_rasterizer`. Raises KernelError."""
    return MapViewer(gaussians, choose_rasterizer(backend, threads))


def view_maps(maps: Mapping[str, Gaussians], threads: int | None = None) -> dict[str, MapViewer]:
    """Return a viewer of each map; all of them share one rasterizer. Raises KernelError."""
    rasterizer = choose_rasterizer(threads=threads)
    return {name: MapViewer(gaussians, rasterizer) for name, gaussians in maps.items()}


_ROUNDS = 4
_REGION_MARGIN_PX = 8
"""A fit at the region uses the region's pixels and this margin: the outline also fixes the pose."""


def render_fitted(viewer: MapViewer, frame: Frame, prior: PoseExposurePrior = HANDHELD_PRIOR) -> Rendering:
    """Return the rendering with the lowest squared colour error among all fitting rounds.

    The unfitted rendering is a candidate, so the full-image error never exceeds that of `render_frame`.
    """
    return _fit_to_image(viewer, frame, prior).rendering


def render_fitted_at_region(
    viewer: MapViewer, view: HeldOutView, prior: PoseExposurePrior = HANDHELD_PRIOR
) -> Rendering:
    """Return the rendering with the lowest squared colour error in the region, fitted at the region alone.

    The fit starts at the pose of `render_fitted`, whose rendering is a candidate. It measures the region's sharpness
    without the pose error that the rest of the map causes.
    """
    frame, best = view.frame, _fit_to_image(viewer, view.frame, prior)
    near = cv2.dilate(view.roi.astype(np.uint8), np.ones((2 * _REGION_MARGIN_PX + 1,) * 2, np.uint8)) > 0
    # the fits compare pixels with a measured depth
    near_frame = replace(frame, depth_m=np.where(near, frame.depth_m, np.float32(0.0)))
    candidates = [best, *_fit(viewer, near_frame, best.T_world_camera, prior)]
    return min(candidates, key=lambda candidate: candidate.squared_error(frame, view.roi)).rendering


@dataclass(frozen=True, slots=True, eq=False)
class _Candidate:
    """A rendering and the pose it was rendered from."""

    T_world_camera: Float64[ndarray, "4 4"]
    rendering: Rendering

    def squared_error(self, frame: Frame, mask: Bool[ndarray, "h w"] | None = None) -> float:
        """Return the mean squared colour error, inside the mask or over the whole image."""
        squared = np.square(self.rendering.rgb - frame.rgb / np.float32(255.0))
        return float(np.mean(squared if mask is None else squared[mask]))


def _fit_to_image(viewer: MapViewer, frame: Frame, prior: PoseExposurePrior) -> _Candidate:
    return min(_fit(viewer, frame, frame.T_world_camera, prior), key=lambda candidate: candidate.squared_error(frame))


def _fit(
    viewer: MapViewer, frame: Frame, T_world_camera: Float64[ndarray, "4 4"], prior: PoseExposurePrior
) -> Iterator[_Candidate]:
    """Yield the rendering from the initial pose, and one with fitted exposure for each round's pose."""
    rendering = viewer.render(frame.camera, T_world_camera, frame.motion)
    yield _Candidate(T_world_camera, rendering)
    for _ in range(_ROUNDS):
        yield _Candidate(T_world_camera, _apply_fitted_exposure(rendering, frame, prior))
        T_world_camera = fit_pose(rendering, inverse(T_world_camera), frame, prior)
        rendering = viewer.render(frame.camera, T_world_camera, frame.motion)
    yield _Candidate(T_world_camera, _apply_fitted_exposure(rendering, frame, prior))


def _apply_fitted_exposure(rendering: Rendering, frame: Frame, prior: PoseExposurePrior) -> Rendering:
    rgb = fit_exposure(rendering, frame, prior).to_photograph(rendering.rgb)
    return Rendering(rgb, rendering.depth_m, rendering.alpha, None)
