"""Exact masks of the home's objects in any frame, by ray casting from the frame's pose."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float64, Int64
from numpy import ndarray

from gausslite.domain.camera import Camera
from gausslite.domain.frame import Frame
from gausslite_sim.scene import HomeScene
from gausslite_sim.view import render_instances

_CACHED_FRAMES = 6


@dataclass(slots=True, eq=False)
class InstanceImageCache:
    """Instance images of the most recent frames; the regions of a source share one cache."""

    scene: HomeScene
    _images: OrderedDict[tuple[Camera, bytes], Int64[ndarray, "h w"]] = field(default_factory=OrderedDict, init=False)

    def of(self, frame: Frame) -> Int64[ndarray, "h w"]:
        """Return the instance image at the frame's camera and pose: indices into HomeScene.names."""
        poses = _row_poses(frame)
        key = (frame.camera, poses.tobytes())
        image = self._images.get(key)
        if image is None:
            image = render_instances(self.scene, frame.camera, poses)
            self._images[key] = image
            # pop, not del: another thread may have removed the same frame
            while len(self._images) > _CACHED_FRAMES:
                self._images.pop(next(iter(self._images)), None)
        return image


def _row_poses(frame: Frame) -> Float64[ndarray, "4 4"] | Float64[ndarray, "h 4 4"]:
    """Return the frame's pose, or those of its rows if they are exposed one after the other."""
    motion, height = frame.motion, frame.camera.height_px
    if motion is None or motion.readout_s == 0.0:
        return frame.T_world_camera
    times_s = motion.readout_s * ((np.arange(height) + 0.5) / height - 0.5)
    return np.stack([frame.T_world_camera @ motion.twist.motion(time_s) for time_s in times_s])


@dataclass(frozen=True, slots=True, eq=False)
class InstanceRegion:
    """Region of one object of the home; its mask includes pixels without depth."""

    name: str
    item: int
    images: InstanceImageCache

    def mask(self, frame: Frame) -> Bool[ndarray, "h w"]:
        """Return the mask of the pixels whose centre shows the object."""
        return np.asarray(self.images.of(frame) == self.item)
