"""Choose keyframes for the server, and pass them to the uplink: the default plug-in of `gausslite.keyframe_uploads`."""

from __future__ import annotations

import logging
from collections.abc import Sequence

from gausslite.domain.errors import InvalidInputError, StorageError
from gausslite.domain.frame import FrameId
from gausslite.domain.voxels import VoxelGrid
from gausslite.mapping.keyframes import Keyframe
from gausslite.wire.convert import KEYFRAME_PNG_COMPRESSION, encode_mask, frame_to_message, pose_of_encoded_frame
from gausslite.wire.spool import SpooledKeyframe
from gausslite.wire.uplink import Uplink
from gausslite_refinement.keyframe_selection import KeyframeAddition, KeyframeSelection, SelectedKeyframe

_log = logging.getLogger(__name__)


class KeyframeUpload:
    """Selects keyframes and passes them to the uplink. Not thread-safe."""

    def __init__(self, uplink: Uplink, grid: VoxelGrid, max_keyframes: int, during_mission: bool) -> None:
        """during_mission: also send while mapping. Raises StorageError for a damaged spool."""
        self._uplink, self._during_mission = uplink, during_mission
        self._selection = KeyframeSelection(max_keyframes, grid, _selected_keyframes(uplink))
        self._last_considered: FrameId | None = None

    def enqueue_newest(self, keyframes: Sequence[Keyframe]) -> None:
        """Send the newest keyframe of the mission, if it adds to the coverage and was not considered yet."""
        if not self._during_mission or not keyframes or keyframes[-1].frame.id == self._last_considered:
            return
        self._last_considered = keyframes[-1].frame.id
        self._send(self._selection.select(keyframes[-1]))

    def enqueue_all(self, keyframes: Sequence[Keyframe]) -> None:
        """Send all keyframes of the mission, as far as the limit allows; those with a corrected pose again."""
        for keyframe in keyframes:
            self._send(self._selection.select(keyframe, min_gain_share=0.0))

    def _send(self, addition: KeyframeAddition | None) -> None:
        if addition is None:
            return
        frame = addition.keyframe.frame
        message = frame_to_message(frame, compact=True)
        message.region_png = encode_mask(addition.keyframe.relevance.roi, KEYFRAME_PNG_COMPRESSION)
        data = message.SerializeToString()
        spooled = SpooledKeyframe(frame.index, addition.gain, addition.coverage, data)
        try:
            self._uplink.enqueue_keyframe(spooled, addition.replaced)
        except StorageError as error:
            # mapping does not depend on it
            _log.warning("keyframe %d is not sent: %s", frame.index, error)


def _selected_keyframes(uplink: Uplink) -> dict[int, SelectedKeyframe]:
    """Return the keyframes in the spool, those from before a restart."""
    known = {}
    for selected_keyframe in uplink.spool.keyframes():
        try:
            T_world_camera = pose_of_encoded_frame(selected_keyframe.data)
        except InvalidInputError as error:
            raise StorageError(f"spool: keyframe {selected_keyframe.frame_index} is damaged: {error}") from error
        known[selected_keyframe.frame_index] = SelectedKeyframe(selected_keyframe.coverage, T_world_camera)
    return known
