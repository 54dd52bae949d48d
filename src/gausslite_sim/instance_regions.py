"""Exact masks of the home's objects in any frame, by casting the frame's own rays."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Int64
from numpy import ndarray

from gausslite.domain.camera import Camera
from gausslite.domain.frame import Frame
from gausslite_sim.scene import HomeScene
from gausslite_sim.view import render_instances

_REMEMBERED_FRAMES = 6


@dataclass(slots=True, eq=False)
class InstanceImageCache:
    """The items in each pixel of the last few frames asked for; the regions of a source share one."""

    scene: HomeScene
    _images: OrderedDict[tuple[Camera, bytes], Int64[ndarray, "h w"]] = field(default_factory=OrderedDict, init=False)

    def of(self, frame: Frame) -> Int64[ndarray, "h w"]:
        """Indices into HomeScene.names at the frame's camera and pose."""
        key = (frame.camera, frame.T_world_camera.tobytes())
        image = self._images.get(key)
        if image is None:
            image = render_instances(self.scene, frame.camera, frame.T_world_camera)
            self._images[key] = image
            # pop, not del: another thread may have dropped the same frame
            while len(self._images) > _REMEMBERED_FRAMES:
                self._images.pop(next(iter(self._images)), None)
        return image


@dataclass(frozen=True, slots=True, eq=False)
class InstanceRegion:
    """One object of the home, wherever a frame sees it (also where the sensor had no return)."""

    name: str
    item: int
    images: InstanceImageCache

    def mask(self, frame: Frame) -> Bool[ndarray, "h w"]:
        """True where the pixel's centre shows the object."""
        return np.asarray(self.images.of(frame) == self.item)
