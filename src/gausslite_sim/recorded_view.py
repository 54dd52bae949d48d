"""Render a view as a real camera records it: through its lens, row by row, each over its exposure time.

Every ray starts from the camera's pose at its own time, so the image is exact up to the number of exposure samples.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float32, Float64
from numpy import ndarray

from gausslite.domain.camera import Camera
from gausslite.domain.lens import Lens
from gausslite.domain.pose import inverse
from gausslite_sim.ray_camera import RayCamera
from gausslite_sim.scene import HomeScene
from gausslite_sim.view import PIXEL_RAYS_PX, View, render_view

_SAMPLE_STEP_PX = 1.0
"""Image motion between two samples of one exposure, at a distance of _NEAR_M: one pixel leaves no ghosts."""
_MAX_SAMPLES = 31
_NEAR_M = 1.5

PosesAt = Callable[[Float64[ndarray, " n"]], Float64[ndarray, "n 4 4"]]
"""Returns T_world_camera at these seconds after the time of the frame."""


@dataclass(frozen=True, slots=True)
class RecordingCamera:
    """A camera, its lens, the time from the first row's exposure to the last one's, and each row's exposure time.

    A frame's time is the middle of the middle row's exposure.
    """

    camera: Camera
    lens: Lens | None = None
    readout_s: float = 0.0
    exposure_s: float = 0.0

    def row_times_s(self) -> Float64[ndarray, " h"]:
        """Return the middle of each row's exposure, in seconds after the frame's time."""
        height = self.camera.height_px
        return self.readout_s * ((np.arange(height) + 0.5) / height - 0.5)


def render_recorded_view(scene: HomeScene, camera: RecordingCamera, poses_at: PosesAt) -> View:
    """Return one view. Colour is the mean over the exposure, the rest is that of the middle of each row's exposure.

    Raises InvalidInputError for a lens that cannot be inverted over the image.
    """
    row_times_s, samples = camera.row_times_s(), _exposure_samples(camera, poses_at)
    shares = (np.arange(samples) + 0.5) / samples - 0.5
    cameras = (
        RayCamera(camera.camera, poses_at(row_times_s + share * camera.exposure_s), camera.lens) for share in shares
    )
    views = [render_view(scene, ray_camera, PIXEL_RAYS_PX[i::samples]) for i, ray_camera in enumerate(cameras)]
    rgb: Float32[ndarray, "h w 3"] = np.stack([view.rgb for view in views]).mean(axis=0, dtype=np.float32)
    return replace(views[samples // 2], rgb=rgb)


def _exposure_samples(camera: RecordingCamera, poses_at: PosesAt) -> int:
    """Return an odd number of samples, so that one lies in the middle of the exposure."""
    if camera.exposure_s == 0:
        return 1
    first, last = poses_at(np.array([-0.5, 0.5]) * camera.exposure_s)
    T_first_last = inverse(first) @ last
    turn_rad = math.acos(min(max(0.5 * (np.trace(T_first_last[:3, :3]) - 1.0), -1.0), 1.0))
    motion_px = camera.camera.angle_px(turn_rad + float(np.linalg.norm(T_first_last[:3, 3])) / _NEAR_M)
    return min(2 * math.ceil(0.5 * motion_px / _SAMPLE_STEP_PX) + 1, _MAX_SAMPLES)
