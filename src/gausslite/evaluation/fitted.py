"""Draw a map for a held-out view with the view's own pose and colour fitted, the same way for every map.

A real camera's pose is a little off and its exposure its own: a sharp map drawn beside the true place scores below a
blurred one. The raw score says what a robot that is_exact its odometry sees; the fitted one how good the map is.
"""

from __future__ import annotations

import numpy as np

from gausslite.calibration.view_fit import HANDHELD_PRIOR, PoseExposurePrior, fit_exposure, fit_pose
from gausslite.domain.frame import Frame
from gausslite.domain.pose import inverse
from gausslite.evaluation.views import MapViewer
from gausslite.render.rasterizer import Rendering

_ROUNDS = 4


def render_fitted(viewer: MapViewer, frame: Frame, prior: PoseExposurePrior = HANDHELD_PRIOR) -> Rendering:
    """The map from the pose that fits the frame, in its colours; of all rounds the one nearest to the frame.

    The first candidate is the unfitted drawing, so over the whole image the answer is never worse than that.
    """
    T_world_camera = frame.T_world_camera
    drawn = viewer.render(frame.camera, T_world_camera)
    candidates = [drawn]
    for _ in range(_ROUNDS):
        candidates.append(_coloured(drawn, frame, prior))
        T_world_camera = fit_pose(drawn, inverse(T_world_camera), frame, prior)
        drawn = viewer.render(frame.camera, T_world_camera)
    candidates.append(_coloured(drawn, frame, prior))
    return min(candidates, key=lambda candidate: _squared_error(candidate, frame))


def _coloured(drawn: Rendering, frame: Frame, prior: PoseExposurePrior) -> Rendering:
    rgb = fit_exposure(drawn, frame, prior).to_photograph(drawn.rgb)
    return Rendering(rgb, drawn.depth_m, drawn.alpha, None)


def _squared_error(drawn: Rendering, frame: Frame) -> float:
    return float(np.mean(np.square(drawn.rgb - frame.rgb / np.float32(255.0))))
