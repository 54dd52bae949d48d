"""Work that the agent does beside mapping: training while no frame waits, keyframes for the server."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence

from gausslite.domain.errors import InvalidInputError, StorageError
from gausslite.domain.frame import FrameId
from gausslite.domain.voxels import VoxelGrid
from gausslite.mapping.keyframe_selection import Coverage, KeyframeAddition, KeyframeSelection, SelectedKeyframe
from gausslite.mapping.keyframes import Keyframe
from gausslite.v1 import geometry_pb2
from gausslite.wire.convert import KEYFRAME_PNG_COMPRESSION, encode_mask, frame_to_message, transform_from_message
from gausslite.wire.spool import SpooledKeyframe
from gausslite.wire.uplink import Uplink

_log = logging.getLogger(__name__)


class IdleTraining:
    """Schedules idle iterations after each frame, up to a limit. All methods run on the mapping worker."""

    def __init__(
        self,
        iterations_per_frame: int,
        step: Callable[[], bool],
        publish_changes: Callable[[], None],
        frame_waits: Callable[[], bool],
        schedule: Callable[[Callable[[], None]], None],
    ) -> None:
        """Step trains one iteration and returns False if it cannot; schedule queues a function on the worker."""
        self._iterations_per_frame = iterations_per_frame
        self._step = step
        self._publish_changes = publish_changes
        self._frame_waits = frame_waits
        self._schedule = schedule
        self._remaining = 0
        self._scheduled = False
        self._has_unpublished = False

    def start(self) -> None:
        """Allow the iterations of one frame, and run the first."""
        self._remaining = self._iterations_per_frame
        if not self._scheduled and self._remaining > 0:
            self._run_one()

    def mark_published(self) -> None:
        """Record that the changes of all iterations so far are published."""
        self._has_unpublished = False

    def stop(self) -> None:
        """End the iterations until the next frame, and publish their changes."""
        self._remaining, self._scheduled = 0, False
        if self._has_unpublished:
            self._has_unpublished = False
            self._publish_changes()

    def _run_one(self) -> None:
        """Run one iteration if no frame waits, and schedule the next behind all queued work.

        An error is logged, because no caller waits for the result, and ends the iterations until the next frame.
        """
        self._scheduled = not self._frame_waits()
        if not self._scheduled:
            return
        try:
            if self._remaining == 0 or not self._step():
                self.stop()
                return
            self._remaining -= 1
            self._has_unpublished = True
            self._schedule(self._run_one)
        except Exception:
            _log.exception("an idle iteration failed; idle training continues after the next frame")
            self._remaining, self._scheduled = 0, False


class KeyframeUpload:
    """Selects keyframes and passes them to the uplink. Not thread-safe."""

    def __init__(self, uplink: Uplink, grid: VoxelGrid, max_keyframes: int, during_mission: bool) -> None:
        """max_keyframes: the most that the server has at a time. during_mission: also send while mapping."""
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
        spooled = SpooledKeyframe(frame.index, addition.gain, addition.coverage.to_bytes(), data)
        try:
            self._uplink.enqueue_keyframe(spooled, addition.replaced)
        except StorageError as error:
            # mapping does not depend on it
            _log.warning("keyframe %d is not sent: %s", frame.index, error)


def _selected_keyframes(uplink: Uplink) -> dict[int, SelectedKeyframe]:
    """Return the keyframes in the spool, those from before a restart."""
    known = {}
    for selected_keyframe in uplink.selected_keyframes():
        message = geometry_pb2.EncodedFrame.FromString(selected_keyframe.data)
        try:
            T_world_camera = transform_from_message("keyframe t_world_camera", message.t_world_camera)
        except InvalidInputError as error:
            raise StorageError(f"spool: keyframe {selected_keyframe.frame_index} is damaged: {error}") from error
        known[selected_keyframe.frame_index] = SelectedKeyframe(
            Coverage.from_bytes(selected_keyframe.coverage), T_world_camera
        )
    return known
