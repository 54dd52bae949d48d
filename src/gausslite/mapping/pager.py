"""Which part of a map is in memory: all of it, or, with a plug-in of `gausslite.pagers`, what the cameras see."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from jaxtyping import Bool, Float64, Int64
from numpy import ndarray

from gausslite.domain.camera import Camera
from gausslite.domain.frame import Frame
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.state import State
from gausslite.domain.voxels import VoxelBatch
from gausslite.mapping.keyframes import Keyframe
from gausslite.mapping.splat_table import SplatTable
from gausslite.mapping.window_view import WindowView


class MapPager:
    """Keeps the whole map in memory. A plug-in derives from it: it moves what no camera sees to disk, and back.

    It is called with MapperSettings, the VoxelGrid of what is published, and the bytes that it may use on disk. What is
    on disk is part of the map, and is not trained. Rows of the table move when parts are stored or loaded.
    """

    @property
    def count(self) -> int:
        """Gaussians on disk."""
        return 0

    def show(self, table: SplatTable, camera: Camera, T_world_camera: Float64[ndarray, "4 4"]) -> None:
        """Load what a camera sees. Raises MapFileError for a damaged part, as all that loads."""

    def prepare(self, table: SplatTable, frame: Frame, window: tuple[WindowView, ...]) -> None:
        """Load what a new frame and the views to train on see; views for which there is no room have to wait."""

    def trainable(self, window: tuple[WindowView, ...]) -> tuple[WindowView, ...]:
        """Return the views that do not wait."""
        return window

    def holds(self, keys: Int64[ndarray, " v"]) -> Bool[ndarray, " v"]:
        """Return True for the voxels of which a part may be on disk, but for those stored since `mark_sent`."""
        return np.zeros(len(keys), np.bool_)

    def admit(self, table: SplatTable, received: VoxelBatch) -> VoxelBatch:
        """Load the map in these voxels; return the voxels of which no part is on disk."""
        return received

    def keep(self, keyframe: Keyframe) -> Keyframe:
        """Return a keyframe that does not train; its images may be in a file."""
        return keyframe

    def stored(self, use_ema: bool, unsent_only: bool = False, seen_by: Frame | None = None) -> Iterator[Gaussians]:
        """Yield copies of the parts on disk. unsent_only: stored since `mark_sent`; seen_by: that a camera may see."""
        return iter(())

    def mark_sent(self) -> None:
        """Note that what was stored so far was published."""

    def reset_roi(self) -> None:
        """Mark all that is on disk as background (`clear_roi`)."""

    def move(self, T_corrected_earlier: Float64[ndarray, "k 4 4"]) -> None:
        """Move all that is on disk with its anchors (`move_with_anchors`)."""

    def state(self) -> State:
        """Return everything that the next frame depends on, as views that are valid until then."""
        return {}

    def restore(self, state: State) -> None:
        """Continue from another pager's state. Raises MapFileError."""
