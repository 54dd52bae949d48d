"""Map each agent's frames, and count what its uplink would send."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

from gausslite.codec.subset_codec import encode_subset, split_batch
from gausslite.domain.frame import Frame
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.voxels import RoiSubset, VoxelBatch, VoxelGrid
from gausslite.fusion.keyframe_pool import AgentKeyframe
from gausslite.mapping.free_space import without_guesses
from gausslite.mapping.keyframes import Keyframe
from gausslite.mapping.voxel_exchange import SentVoxelTracker
from gausslite.mission.build import build_mapper
from gausslite.mission.frame_scheduler import FrameScheduler
from gausslite.mission.runner import MissionRunner
from gausslite.mission.settings import MissionSettings
from gausslite.mission.task_mapper import FrameOutcome, TaskMapper
from gausslite.perception.relevance import NoTaskEstimator
from gausslite.wire.spool import Purpose, Spool
from gausslite.wire.update_sender import UplinkSettings
from gausslite_bench.quality.scenes import RecordedRelevanceEstimator, Scene
from gausslite_bench.quality.trials import message_bytes
from gausslite_refinement.keyframe_selection import KeyframeSelection

_ROUND_FRAMES = 4
_SUBSET_BYTES = 1 << 20
_MAX_KEYFRAMES = 64


@dataclass(frozen=True, slots=True, eq=False)
class AgentMap:
    """One agent's map as it hands it over, its keyframes, and the subsets that it sent, in order.

    bytes_sent: of all messages, resends included. bytes_whole: size of its whole map as messages.
    """

    agent_id: str
    gaussians: Gaussians
    keyframes: tuple[AgentKeyframe, ...]
    messages: tuple[RoiSubset, ...]
    bytes_sent: int
    bytes_whole: int


class _SentMessages:
    """A spool that is read every few frames by the uplink's rule: what has changed enough, the largest change first."""

    def __init__(self, agent_id: str, grid: VoxelGrid) -> None:
        self._agent_id, self._grid = agent_id, grid
        self._spool = Spool(None, agent_id, grid)
        self.messages: list[RoiSubset] = []
        self.byte_count = 0

    def publish(self, batch: VoxelBatch) -> None:
        """Queue the changed voxels of a frame."""
        self._spool.enqueue(batch, Purpose.ROI)

    def send(self, resend_threshold: float = UplinkSettings().resend_threshold) -> None:
        """Send all that is due."""
        while (due := self._spool.next_round(_SUBSET_BYTES, resend_threshold)) is not None and due.voxels is not None:
            for part in split_batch(due.voxels.batch, _SUBSET_BYTES):
                number = len(self.messages) + 1
                message = RoiSubset(self._agent_id, "", number, number, part)
                self.byte_count += len(encode_subset(message, self._grid))
                self.messages.append(message)
            self._spool.mark_done(due.voxels)


def map_agent(agent_id: str, scene: Scene, settings: MissionSettings, grid: VoxelGrid) -> AgentMap:
    """Return the agent's map after all its frames. A policy without a task sends its whole map once, at the end."""
    follows_task = settings.mapper_settings().components.follow_task
    estimator = RecordedRelevanceEstimator(scene) if follows_task else NoTaskEstimator()
    sent = _SentMessages(agent_id, grid)
    gaussian_mapper = build_mapper(settings)
    mapper = TaskMapper(
        estimator,
        gaussian_mapper,
        SentVoxelTracker(grid),
        FrameScheduler(settings.scheduler_settings),
        sent.publish,
    )
    numbers = itertools.count(1)

    def after_frame(_outcome: FrameOutcome) -> None:
        if next(numbers) % _ROUND_FRAMES == 0:
            sent.send()

    MissionRunner(mapper.process, after_frame).run(scene.training).raise_if_stopped()
    sent.send(0.0)
    keyframes = tuple(AgentKeyframe(agent_id, frame) for frame in _select_keyframes(mapper.keyframes(), grid))
    gaussians = without_guesses(gaussian_mapper.gaussians(), (kept.frame for kept in gaussian_mapper.store.kept))
    return AgentMap(
        agent_id=agent_id,
        gaussians=gaussians,
        keyframes=keyframes,
        messages=tuple(sent.messages),
        bytes_sent=sent.byte_count,
        bytes_whole=message_bytes(gaussians, grid),
    )


def _select_keyframes(keyframes: Sequence[Keyframe], grid: VoxelGrid) -> list[Frame]:
    """Return the frames that an agent with a handover has sent at its end."""
    selection = KeyframeSelection(_MAX_KEYFRAMES, grid)
    frames: dict[int | None, Frame] = {}
    for keyframe in keyframes:
        selected = selection.select(keyframe, min_gain_share=0.0)
        if selected is not None:
            frames[keyframe.frame.index] = keyframe.frame
            frames.pop(selected.replaced, None)
    return list(frames.values())
