"""A sequence with unregistered depth whose colour images are undistorted when they are read; depth stays as it is."""

from __future__ import annotations

from dataclasses import replace

from gausslite.datasets.camera_correction import undistort_colour
from gausslite.datasets.images import RgbdImage, resize_rgbd
from gausslite.datasets.wrapped_source import WrappedSource
from gausslite.domain.frame import Frame
from gausslite.domain.lens import Lens


class UndistortedColourSource(WrappedSource):
    """A source whose stated lens is that of the colour camera alone. The colour images keep the stated intrinsics.

    Depth is registered to the undistorted images afterwards. A source without a lens returns its frames unchanged.
    """

    @property
    def lens(self) -> Lens | None:
        """None: colour is undistorted, and depth images of such sensors have no stated distortion."""
        return None

    def frame(self, i: int, size: tuple[int, int] | None = None) -> Frame:
        """Return the frame at position i with undistorted colour. Raises DatasetError, PoseError."""
        lens = self._source.lens
        if lens is None:
            return self._source.frame(i, size)
        recorded = self._source.frame(i)
        rgb = undistort_colour(recorded.rgb, recorded.camera, lens)
        image = resize_rgbd(RgbdImage(rgb, recorded.depth_m, recorded.camera), size)
        return replace(
            recorded, rgb=image.rgb, depth_m=image.depth_m, camera=image.camera, recorded_rgb=image.recorded_rgb
        )
