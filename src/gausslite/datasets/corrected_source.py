"""A sequence whose frames are undistorted, and corrected for or annotated with the camera's motion, when read."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gausslite.datasets.camera_correction import correct_frame, ideal_camera, undistort_frame
from gausslite.datasets.images import RgbdImage, resize_rgbd
from gausslite.datasets.source import Source
from gausslite.datasets.wrapped_source import WrappedSource
from gausslite.domain.camera import Camera
from gausslite.domain.camera_correction import CameraCorrection
from gausslite.domain.frame import Frame
from gausslite.domain.lens import Lens
from gausslite.domain.trajectory import Trajectory

_SPEED_QUANTILE = 0.9
"""Frames that turn faster than this share of all frames repeat the image's border in a few pixels."""


class CorrectedSource(WrappedSource):
    """A source without lens distortion and time offset; each frame's motion states rolling shutter and motion blur.

    rectified: also remove the rolling shutter, as if all rows were exposed at once. Comparisons of frames with each
    other need this. The rasterizer models the shutter itself, which is sharper and keeps the field of view.
    Colour and depth are undistorted alike, so depth must be registered to colour. A source without correction returns
    its frames unchanged. Raises InvalidInputError.
    """

    def __init__(self, source: Source, correction: CameraCorrection, rectified: bool = False) -> None:
        super().__init__(source)
        self._correction, self._rectified = correction, rectified
        self._trajectory = source.trajectory()
        if not rectified:
            self._camera = ideal_camera(source.camera, replace(correction, readout_s=0.0), 0.0)
            return
        speeds_rad_s = self._trajectory.angular_speeds_rad_s() if correction.readout_s != 0.0 else np.zeros(1)
        self._camera = ideal_camera(source.camera, correction, float(np.quantile(speeds_rad_s, _SPEED_QUANTILE)))

    def rectified(self) -> CorrectedSource:
        """Return the same source with its rolling shutter removed."""
        return CorrectedSource(self._source, self._correction, rectified=True)

    @property
    def camera(self) -> Camera:
        """The ideal camera, of the recorded images' size."""
        return self._camera

    @property
    def lens(self) -> Lens | None:
        """None: frames are undistorted."""
        return None

    def frame(self, i: int, size: tuple[int, int] | None = None) -> Frame:
        """Return the corrected frame at position i. Raises DatasetError, PoseError."""
        # at full size: a resized image has lost the pixels that the lookup needs
        recorded = self._source.frame(i)
        correct = correct_frame if self._rectified else undistort_frame
        frame = correct(recorded, self._correction, self._camera, self._trajectory.twist(i))
        if frame.motion is not None and not self._trajectory.is_steady(i):
            # a blur along a wrong velocity does more harm than none
            frame = replace(frame, motion=replace(frame.motion, exposure_s=0.0))
        image = resize_rgbd(RgbdImage(frame.rgb, frame.depth_m, frame.camera), size)
        return replace(
            frame, rgb=image.rgb, depth_m=image.depth_m, camera=image.camera, recorded_rgb=image.recorded_rgb
        )

    def trajectory(self) -> Trajectory:
        """The wrapped source's trajectory, as recorded."""
        return self._trajectory
