"""Views that no map was trained on, and their renderings after fitting pose and exposure.

Poses of real cameras have errors and exposures differ between frames. Without fitting, a sharp map rendered from a
slightly wrong pose scores below a blurred map. The raw score includes pose errors; the fitted score measures the map.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64
from numpy import ndarray

from gausslite.domain.arrays import require_array
from gausslite.domain.frame import Frame
from gausslite.domain.pose import inverse
from gausslite.domain.recording import HANDHELD_PRIOR, PoseExposurePrior
from gausslite.domain.relevance import MIN_ROI_PIXELS, Region
from gausslite.render.map_viewer import MapViewer
from gausslite.render.rasterizer import Rendering
from gausslite_poses.exposure import fit_exposure
from gausslite_poses.photometric import fit_pose


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


def largest_roi_per_segment(roi_pixels: Sequence[int], count: int) -> set[int]:
    """Return the place of the largest region in each of `count` segments; of small ones only if all are small."""
    if count < 1:
        return set()
    pixels = np.array(roi_pixels)
    segments = [part for part in np.array_split(np.arange(len(pixels)), count) if len(part)]
    best = {int(part[np.argmax(pixels[part])]) for part in segments}
    return {i for i in best if pixels[i] >= MIN_ROI_PIXELS} or best


def largest_roi_views(views: Sequence[HeldOutView], count: int) -> set[int]:
    """Return the positions of the views with the largest region in each of `count` segments of the sequence."""
    return largest_roi_per_segment([int(np.count_nonzero(view.roi)) for view in views], count)


_ROUNDS = 4


def render_fitted(viewer: MapViewer, frame: Frame, prior: PoseExposurePrior = HANDHELD_PRIOR) -> Rendering:
    """Return the rendering with the lowest squared colour error among all fitting rounds.

    The unfitted rendering is a candidate, so the full-image error never exceeds that of `render_frame`.
    """
    return _fit_to_image(viewer, frame, prior).rendering


@dataclass(frozen=True, slots=True, eq=False)
class _Candidate:
    """A rendering and the pose it was rendered from."""

    T_world_camera: Float64[ndarray, "4 4"]
    rendering: Rendering

    def squared_error(self, frame: Frame) -> float:
        """Return the mean squared colour error."""
        return float(np.mean(np.square(self.rendering.rgb - frame.rgb / np.float32(255.0))))


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
