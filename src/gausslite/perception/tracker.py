"""Follow a task's targets from frame to frame: place detections in space, keep those that fit, carry them over."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64
from numpy import ndarray
from numpy.typing import NDArray

from gausslite.domain.frame import Frame
from gausslite.domain.pose import UpAxis, require_rigid, rotation_angle_deg, translation_m, unit_up_axis
from gausslite.domain.relevance import NO_TARGET, Detection, RelevanceMap
from gausslite.domain.state import State, add_prefix, get_array, get_counts, int_array, select_prefix
from gausslite.domain.task import TaskGraph
from gausslite.errors import InvalidInputError, MapFileError
from gausslite.perception.checkpoint import decode_frustum, decode_landmark, encode_frustum, encode_landmark
from gausslite.perception.detect import Segmenter
from gausslite.perception.evidence import EvidenceSettings, VisibilityCheck
from gausslite.perception.foreground import foreground_mask
from gausslite.perception.object_map import Landmark, Observation
from gausslite.perception.relations import SpatialSettings
from gausslite.perception.reproject import Frustum, lift_frustum, mask_in_frustum, reprojected_box_px
from gausslite.perception.spatial import SpatialFilter, lift_observation
from gausslite.perception.vocabulary import is_generic


@dataclass(frozen=True, slots=True)
class TrackerSettings:
    """up_axis points up in the world, by default that of a level first camera; max_* say when to detect anew.

    How far the camera may go between two detections is a comment in Sec. III-B.2. A target that was believed is carried
    on over up to max_missed_detections detections that do not find it.
    """

    up_axis: UpAxis = (0.0, -1.0, 0.0)
    max_translation_m: float = 1.0
    max_rotation_deg: float = 15.0
    max_frames: int = 5
    max_missed_detections: int = 2
    spatial: SpatialSettings = field(default_factory=SpatialSettings)
    evidence: EvidenceSettings = field(default_factory=EvidenceSettings)

    def __post_init__(self) -> None:
        for name in ("max_translation_m", "max_rotation_deg"):
            if not getattr(self, name) > 0:
                raise InvalidInputError(f"tracker {name}: expected a positive number, got {getattr(self, name)}")
        unit_up_axis(self.up_axis)
        if self.max_missed_detections < 0:
            raise InvalidInputError(f"tracker max_missed_detections: expected at least 0, got {self.max_missed_detections}")
        if self.max_frames < 1:
            raise InvalidInputError(f"tracker max_frames: expected at least 1, got {self.max_frames}")


class TargetTracker:
    """Owns the latest keyframe and the memory of objects, and asks no detector itself. One thread at a time."""

    def __init__(self, graph: TaskGraph, settings: TrackerSettings, segmenter: Segmenter | None) -> None:
        """Without a segmenter, carried boxes are cut out by depth alone."""
        self._graph = graph
        self._settings = settings
        self._segmenter = segmenter
        self._filter = SpatialFilter(graph, settings.up_axis, settings.spatial, settings.evidence)
        self._T_world_keyframe: Float64[ndarray, "4 4"] | None = None
        self._frames_since = 0
        self._frustums: list[Frustum] = []
        self._needs_observation = False

    @property
    def notes(self) -> tuple[str, ...]:
        """Anchors that have not come into view."""
        return tuple(f"anchor {name!r} not seen yet: its targets are kept" for name in self._filter.unseen_anchors)

    @property
    def landmarks(self) -> tuple[Landmark, ...]:
        """The objects that the task's nouns have named so far, where they were seen."""
        return self._filter.landmarks

    def state(self) -> State:
        """The objects seen so far, the detections that are carried on, and where they were made."""
        pose = np.zeros((0, 4, 4)) if self._T_world_keyframe is None else self._T_world_keyframe[None]
        state: dict[str, NDArray[Any]] = {
            "T_world_keyframe": pose,
            "since": int_array(self._frames_since, self._needs_observation),
        }
        state["counts"] = int_array(len(self._frustums), len(self.landmarks))
        for i, frustum in enumerate(self._frustums):
            state |= add_prefix(f"kept-{i}", encode_frustum(frustum))
        for i, each in enumerate(self.landmarks):
            state |= add_prefix(f"object-{i}", encode_landmark(each))
        return state

    def restore(self, state: State) -> None:
        """Remember and carry on what another attention to this task did. Raises MapFileError, InvalidInputError."""
        poses = get_array(state, "T_world_keyframe", (None, 4, 4), np.float64)
        kept, objects = get_counts(state, "counts", 2)
        if len(poses) > 1 or kept + objects > len(state):
            raise MapFileError(f"state tracker: expected {kept} detections and {objects} objects, got fewer")
        for pose in poses:
            require_rigid("state T_world_keyframe", pose)
        self._frustums = [decode_frustum(select_prefix(state, f"kept-{i}")) for i in range(kept)]
        strangers = {frustum.detection.phrase for frustum in self._frustums} - set(self._graph.targets)
        if strangers:
            raise MapFileError(f"state tracker: expected targets of the task, got {len(strangers)} other phrases")
        self._filter.restore_landmarks([decode_landmark(select_prefix(state, f"object-{i}")) for i in range(objects)])
        self._T_world_keyframe = poses[0].copy() if len(poses) else None
        self._frames_since, needs_observation = get_counts(state, "since", 2)
        self._needs_observation = needs_observation > 0

    def update_keyframe(self, frame: Frame) -> bool:
        """True for the first frame, after some frames, and once the camera went far; such a frame is a keyframe."""
        T_world_keyframe = self._T_world_keyframe
        self._frames_since += 1
        due = (
            T_world_keyframe is None
            or self._frames_since >= self._settings.max_frames
            or (self._needs_observation and self._frames_since == 1)
            or translation_m(T_world_keyframe, frame.T_world_camera) > self._settings.max_translation_m
            or rotation_angle_deg(T_world_keyframe, frame.T_world_camera) > self._settings.max_rotation_deg
        )
        if due:
            self._T_world_keyframe, self._frames_since = frame.T_world_camera, 0
        return due

    def integrate(self, frame: Frame, depth_m: Float32[ndarray, "h w"], found: Sequence[Detection]) -> RelevanceMap:
        """What was detected on a frame: the targets that fit the task's relations, from now on carried over."""
        sighted = self._observe(frame, depth_m, found)
        targets = [detection for detection, _ in sighted]
        missed_detections = self._undetected(frame, depth_m, [observation for _, observation in sighted])
        lifted = [lift_frustum(detection, depth_m, frame) for detection in targets]
        self._frustums = [*(frustum for frustum in lifted if frustum is not None), *(old for old, _ in missed_detections)]
        return merge_detections([*targets, *(shown for _, shown in missed_detections)], self._graph.targets, frame)

    def evaluate_past(self, frame: Frame, found: Sequence[Detection]) -> RelevanceMap:
        """What was detected on an earlier frame: it is remembered, but newer detections are carried on."""
        sighted = self._observe(frame, frame.depth_m, found)
        return merge_detections([detection for detection, _ in sighted], self._graph.targets, frame)

    def propagate(self, frame: Frame) -> RelevanceMap:
        """The latest targets as they are seen from another frame."""
        shown = self._propagated_detections(frame)
        if self._segmenter is not None and shown:
            table = np.asarray([detection.box_px for _, detection in shown], np.float32)
            cut_again = self._segmenter.segment(frame, table)
            shown = [
                (frustum, detection if mask is None else replace(detection, mask=mask))
                for (frustum, detection), mask in zip(shown, cut_again, strict=True)
            ]
        return merge_detections([detection for _, detection in shown], self._graph.targets, frame)

    def _propagated_detections(self, frame: Frame) -> list[tuple[Frustum, Detection]]:
        """The detections that are carried and in view of this frame, as it sees them."""
        boxes = [(frustum, reprojected_box_px(frustum, frame)) for frustum in self._frustums]
        return [
            (frustum, replace(frustum.detection, box_px=box, mask=mask_in_frustum(frustum, box, frame)))
            for frustum, box in boxes
            if box is not None
        ]

    def _undetected(
        self, frame: Frame, depth_m: Float32[ndarray, "h w"], found: Sequence[Observation]
    ) -> list[tuple[Frustum, Detection]]:
        """What is carried and in view, was not found again, and yet is still believed: detectors blink."""
        left = []
        for frustum, shown in self._propagated_detections(frame):
            observation = lift_observation(shown, depth_m, frame)
            if observation is None or frustum.missed_detections >= self._settings.max_missed_detections:
                continue
            again = any(self._filter.is_same_object(observation, other) for other in found)
            if not again and self._filter.is_reliable(observation) and self._filter.satisfies_relations(observation):
                left.append((replace(frustum, missed_detections=frustum.missed_detections + 1), shown))
        return left

    def _observe(
        self, frame: Frame, depth_m: Float32[ndarray, "h w"], found: Sequence[Detection]
    ) -> list[tuple[Detection, Observation]]:
        """Remember what was detected; the targets that are believed and fit the task's relations."""
        detections = [
            replace(each, mask=foreground_mask(each.mask, depth_m)) for each in self._drop_generic_anchors(found)
        ]
        placed = [lift_observation(each, depth_m, frame) for each in detections]
        self._filter.observe([observation for observation in placed if observation is not None], VisibilityCheck(frame, frame.depth_m))
        targets = [
            (detection, observation)
            for detection, observation in zip(detections, placed, strict=True)
            if detection.phrase in self._graph.targets and observation is not None and self._filter.satisfies_relations(observation)
        ]
        self._needs_observation = any(self._filter.needs_observation(observation) for _, observation in targets)
        return [(detection, observation) for detection, observation in targets if self._filter.is_confirmed(observation)]

    def _drop_generic_anchors(self, detections: Sequence[Detection]) -> list[Detection]:
        """The object on the desk is not the desk itself, although a desk is an object."""
        anchors = [each.mask for each in detections if each.phrase in self._graph.anchors]
        return [
            each
            for each in detections
            if not (is_generic(each.phrase) and any(each.mask is anchor for anchor in anchors))
        ]


def merge_detections(detections: Sequence[Detection], targets: Sequence[str], frame: Frame) -> RelevanceMap:
    """The binary w(u, v): 1 on every target's mask; where masks overlap the smaller object owns the pixel."""
    target = np.full(frame.depth_m.shape, NO_TARGET, np.int16)
    for detection in sorted(detections, key=lambda each: int(np.count_nonzero(each.mask)), reverse=True):
        target[detection.mask] = targets.index(detection.phrase)
    return RelevanceMap((target != NO_TARGET).astype(np.float32), target)
