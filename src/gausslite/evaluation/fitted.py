"""Render a map for a held-out view after fitting the view's pose and exposure.

Poses of real cameras have errors and exposures differ between frames. Without fitting, a sharp map rendered from a
slightly wrong pose scores below a blurred map. The raw score includes pose errors; the fitted score measures the map.
"""

from __future__ import annotations

import numpy as np

from gausslite.calibration.exposure import fit_exposure
from gausslite.calibration.pose_fit import fit_pose
from gausslite.domain.frame import Frame
from gausslite.domain.pose import inverse
from gausslite.domain.pose_exposure_prior import HANDHELD_PRIOR, PoseExposurePrior
from gausslite.evaluation.views import MapViewer
from gausslite.render.rasterizer import Rendering

_ROUNDS = 4


def render_fitted(viewer: MapViewer, frame: Frame, prior: PoseExposurePrior = HANDHELD_PRIOR) -> Rendering:
    """Return the rendering with the lowest squared colour error among all fitting rounds.

    The unfitted rendering is a candidate, so the full-image error never exceeds that of `render_frame`.
    """
    T_world_camera = frame.T_world_camera
    rendering = viewer.render(frame.camera, T_world_camera)
    candidates = [rendering]
    for _ in range(_ROUNDS):
        candidates.append(_apply_fitted_exposure(rendering, frame, prior))
        T_world_camera = fit_pose(rendering, inverse(T_world_camera), frame, prior)
        rendering = viewer.render(frame.camera, T_world_camera)
    candidates.append(_apply_fitted_exposure(rendering, frame, prior))
    return min(candidates, key=lambda candidate: _squared_error(candidate, frame))


def _apply_fitted_exposure(rendering: Rendering, frame: Frame, prior: PoseExposurePrior) -> Rendering:
    rgb = fit_exposure(rendering, frame, prior).to_photograph(rendering.rgb)
    return Rendering(rgb, rendering.depth_m, rendering.alpha, None)


def _squared_error(rendering: Rendering, frame: Frame) -> float:
    return float(np.mean(np.square(rendering.rgb - frame.rgb / np.float32(255.0))))
