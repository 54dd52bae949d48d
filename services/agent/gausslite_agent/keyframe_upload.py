"""The protocol of what chooses and sends a robot's keyframes, a plug-in of `gausslite.keyframe_uploads`."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from typing import Protocol

from gausslite.domain.voxels import VoxelGrid
from gausslite.mapping.keyframes import Keyframe
from gausslite.plugins import Group, find
from gausslite.wire.uplink import Uplink

_log = logging.getLogger(__name__)


class KeyframeUpload(Protocol):
    """Selects keyframes and passes them to the uplink. Not thread-safe."""

    def enqueue_newest(self, keyframes: Sequence[Keyframe], /) -> None:
        """Send the newest keyframe of the mission, if it should be sent while mapping."""

    def enqueue_all(self, keyframes: Sequence[Keyframe], /) -> None:
        """Send all keyframes of the mission, as far as the limit allows; those with a corrected pose again."""


OpenUpload = Callable[[Uplink, VoxelGrid, int, bool], KeyframeUpload]
"""The plug-in: the most keyframes, and whether they are sent while mapping. Raises StorageError for a damaged spool."""


def open_upload(uplink: Uplink, grid: VoxelGrid, max_keyframes: int, during_mission: bool) -> KeyframeUpload | None:
    """Return the upload of at most so many keyframes; None without a plug-in."""
    create: OpenUpload | None = find(Group.KEYFRAME_UPLOADS)
    if create is None:
        _log.warning("no keyframes are sent: no plug-in of %s is installed", Group.KEYFRAME_UPLOADS)
        return None
    return create(uplink, grid, max_keyframes, during_mission)
