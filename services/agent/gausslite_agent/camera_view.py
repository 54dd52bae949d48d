"""What the robot's camera sees, from the mapper's keyframes and poses."""

from __future__ import annotations

import numpy as np

from gausslite.domain.relevance import DetectedImage
from gausslite.mapping.mapper import GaussianMapper
from gausslite.wire.camera_view import CameraView

_NS_PER_S = 1e9


def newest_camera_view(mapper: GaussianMapper, detected: DetectedImage | None) -> CameraView | None:
    """Return the newest keyframe, the camera's path and the newest detection; None before the first keyframe."""
    keyframes = mapper.keyframes()
    if not keyframes:
        return None
    newest, trajectory = keyframes[-1], mapper.poses.trajectory()
    return CameraView(
        rgb=newest.as_recorded.rgb,
        roi=newest.relevance.roi,
        camera=newest.frame.camera,
        frame_index=newest.frame.index,
        T_world_camera=newest.frame.T_world_camera,
        times_ns=np.round(trajectory.times_s * _NS_PER_S).astype(np.int64),
        path=trajectory.T_world_camera,
        keyframes=np.stack([each.frame.T_world_camera for each in keyframes]),
        detected=detected,
    )
