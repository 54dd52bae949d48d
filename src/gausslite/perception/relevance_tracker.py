"""Decide the relevance of each frame: which pixels show the task's targets.

Detections are localised in 3D and filtered by the task's relations. The masks of all frames follow from the measured
surfaces of the objects.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Float64
from numpy import ndarray
from numpy.typing import NDArray

from gausslite.domain.errors import InvalidInputError, MapFileError
from gausslite.domain.frame import Frame
from gausslite.domain.noun_match import NounMatch, NounReport
from gausslite.domain.object_names import is_generic
from gausslite.domain.objects import ObjectLandmark
from gausslite.domain.pose import UpAxis, require_rigid, rotation_angle_deg, translation_m, unit_up_axis
from gausslite.domain.relevance import NO_TARGET, Detection, RelevanceMap
from gausslite.domain.state import State, add_prefix, get_array, get_counts, int_array, select_prefix
from gausslite.domain.task import TaskGraph, noun_of
from gausslite.perception.checkpoint import decode_floor, decode_landmark, encode_landmark
from gausslite.perception.evidence import EvidenceSettings, VisibilityCheck
from gausslite.perception.lifting import lift_detections
from gausslite.perception.object_map import Landmark
from gausslite.perception.object_masks import refined_mask, surface_mask
from gausslite.perception.object_report import describe_landmarks
from gausslite.perception.relations import SpatialSettings
from gausslite.perception.spatial import SpatialFilter

# a detection with a smaller share of its pixels outside excluded objects shows one of them
_MIN_SHARE_LEFT = 0.3
# a frame whose relevance has this share of an object's surface shows the object
_MIN_SHOWN_SHARE = 0.5


@dataclass(frozen=True, slots=True)
class RelevanceTrackerSettings:
    """Limits of the camera's motion and of the frames between two detections (a comment in Sec. III-B.2).

    up_axis: up in the world frame, by default that of a level first camera.
    """

    up_axis: UpAxis = (0.0, -1.0, 0.0)
    max_translation_m: float = 1.0
    max_rotation_deg: float = 15.0
    max_frames: int = 5
    spatial: SpatialSettings = field(default_factory=SpatialSettings)
    evidence: EvidenceSettings = field(default_factory=EvidenceSettings)

    def __post_init__(self) -> None:
        for name in ("max_translation_m", "max_rotation_deg"):
            if not getattr(self, name) > 0:
                raise InvalidInputError(f"tracker {name}: expected a positive number, got {getattr(self, name)}")
        unit_up_axis(self.up_axis)
        if self.max_frames < 1:
            raise InvalidInputError(f"tracker max_frames: expected at least 1, got {self.max_frames}")


class RelevanceTracker:
    """State of the tracked targets: latest keyframe, landmarks with their surfaces. Use from one thread at a time.

    The caller runs the detector.
    """

    def __init__(
        self,
        graph: TaskGraph,
        settings: RelevanceTrackerSettings,
        nouns_by_height: frozenset[str] = frozenset(),
    ) -> None:
        """nouns_by_height: surfaces that the detector cannot find, whose height above the floor is known."""
        self._graph = graph
        self._settings = settings
        self._filter = SpatialFilter(graph, settings.up_axis, settings.spatial, settings.evidence, nouns_by_height)
        self._T_world_keyframe: Float64[ndarray, "4 4"] | None = None
        self._frames_since = 0
        self._needs_observation = False
        self._known_targets: list[int] = []

    @property
    def known_objects(self) -> int:
        """The number of targets that were detected often enough so far."""
        return len(self._known_targets)

    @property
    def notes(self) -> tuple[str, ...]:
        """What colours decided, different things, low scores, and anchors that no frame has shown yet."""
        rivals = (
            f"what looks like {each.phrase!r} is rather {rival!r}: not activated; --accept-similar accepts it"
            for each, rival in self._filter.rivals
        )
        viewpoint = self._T_world_keyframe
        low_scores = (
            f"{target!r}: {count} scored far below the best, so not activated; --accept-similar accepts all"
            for target, count in ({} if viewpoint is None else self._filter.low_score_counts(viewpoint)).items()
        )
        unseen = (f"anchor {name!r} not seen yet: its targets are kept" for name in self._filter.unseen_anchors)
        return (*self._filter.colour_notes, *self._filter.height_notes, *dict.fromkeys(rivals), *low_scores, *unseen)

    @property
    def landmarks(self) -> tuple[Landmark, ...]:
        """All objects detected so far for the task's nouns, in world coordinates."""
        return self._filter.landmarks

    @property
    def objects(self) -> tuple[ObjectLandmark, ...]:
        """The confirmed objects of the task, in the order of their first detection."""
        return describe_landmarks(self._filter.confirmed_landmarks, self._graph)

    def report(self, match: NounMatch) -> NounReport:
        """Return what has been detected of a noun so far."""
        landmarks = [each for each in self.landmarks if each.phrase == match.noun]
        confirmed = sum(each.phrase == match.noun for each in self._filter.confirmed_landmarks)
        rival = next((name for each, name in self._filter.rivals if each.phrase == match.noun), None)
        best_score = max((each.best_score for each in landmarks), default=0.0)
        return NounReport(match, sum(each.seen_count for each in landmarks), best_score, confirmed, rival)

    def state(self) -> State:
        """Return the landmarks and the keyframe's pose as named arrays."""
        pose = np.zeros((0, 4, 4)) if self._T_world_keyframe is None else self._T_world_keyframe[None]
        state: dict[str, NDArray[Any]] = {
            "T_world_keyframe": pose,
            "keyframe_age": int_array(self._frames_since, self._needs_observation),
            "known_targets": int_array(*self._known_targets),
        }
        floor = self._filter.floor
        levels = [] if floor.first_camera_m is None else [floor.first_camera_m]
        state |= {"floor_counts": floor.counts, "first_camera_m": np.array(levels, np.float64)}
        state["count"] = int_array(len(self.landmarks))
        for i, landmark in enumerate(self.landmarks):
            state |= add_prefix(f"landmark-{i}", encode_landmark(landmark))
        return state

    def restore(self, state: State) -> None:
        """Replace the state by that of a tracker of the same task. Raises MapFileError, InvalidInputError."""
        poses = get_array(state, "T_world_keyframe", (None, 4, 4), np.float64)
        (landmarks,) = get_counts(state, "count", 1)
        if len(poses) > 1 or landmarks > len(state):
            raise MapFileError(f"state tracker: expected {landmarks} landmarks, got fewer")
        for pose in poses:
            require_rigid("state T_world_keyframe", pose)
        saved_landmarks = [select_prefix(state, f"landmark-{i}") for i in range(landmarks)]
        floor = decode_floor(state)
        self._filter.restore([decode_landmark(each) for each in saved_landmarks], floor)
        self._T_world_keyframe = poses[0].copy() if len(poses) else None
        self._frames_since, needs_observation = get_counts(state, "keyframe_age", 2)
        self._needs_observation = needs_observation > 0
        self._known_targets = list(get_counts(state, "known_targets", len(state.get("known_targets", ()))))

    def update_keyframe(self, frame: Frame) -> bool:
        """Return whether this frame needs a detection, and make it the keyframe if so.

        Keyframes are the first frame, every max_frames-th frame, a frame far from the keyframe, and the frame after a
        detection whose target needs another observation.
        """
        T_world_keyframe = self._T_world_keyframe
        self._frames_since += 1
        is_keyframe = (
            T_world_keyframe is None
            or self._frames_since >= self._settings.max_frames
            or (self._needs_observation and self._frames_since == 1)
            or translation_m(T_world_keyframe, frame.T_world_camera) > self._settings.max_translation_m
            or rotation_angle_deg(T_world_keyframe, frame.T_world_camera) > self._settings.max_rotation_deg
        )
        if is_keyframe:
            self._T_world_keyframe, self._frames_since = frame.T_world_camera, 0
        return is_keyframe

    def integrate(
        self, frame: Frame, depth_m: Float32[ndarray, "h w"], detections: Sequence[Detection]
    ) -> RelevanceMap:
        """Return the relevance of a frame with detections; they update the objects."""
        detected = self._observe(frame, depth_m, detections)
        return self._relevance(frame, detected)

    def propagate(self, frame: Frame) -> RelevanceMap:
        """Return the relevance of a frame without detections: the surfaces of the targets, wherever it shows them."""
        return self._relevance(frame, [])

    def complete(self, frame: Frame, relevance: RelevanceMap) -> RelevanceMap:
        """Return an earlier frame's relevance with the targets that became known since, where it does not show them."""
        new = self._known_targets[relevance.known_objects :]
        masks = [
            (name, surface_mask(landmark.votes, frame))
            for landmark, name in self._filter.targets(self._viewpoint(frame))
            if landmark.number in new
        ]
        missed = [
            (name, mask)
            for name, mask in masks
            if np.count_nonzero(mask & relevance.roi) < _MIN_SHOWN_SHARE * np.count_nonzero(mask)
        ]
        added = merge_masks(missed, self._graph.targets, frame)
        is_new = added.roi & ~relevance.roi
        return RelevanceMap(
            np.where(is_new, added.pixel_weights, relevance.pixel_weights),
            np.where(is_new, added.target, relevance.target),
            self.known_objects,
        )

    def _viewpoint(self, frame: Frame) -> Float64[ndarray, "4 4"]:
        return frame.T_world_camera if self._T_world_keyframe is None else self._T_world_keyframe

    def _relevance(self, frame: Frame, detected: Sequence[tuple[Landmark, Bool[ndarray, "h w"]]]) -> RelevanceMap:
        """Return the masks of all targets. A detected mask adds pixels that no other frame shows outside its object."""
        masks = []
        for landmark, name in self._filter.targets(self._viewpoint(frame)):
            if landmark.number not in self._known_targets and self._settings.evidence.is_known(landmark):
                self._known_targets.append(landmark.number)
            own = [mask for owner, mask in detected if owner is landmark]
            if own:
                mask = refined_mask(np.logical_or.reduce(own), landmark.votes, frame)
            else:
                mask = surface_mask(landmark.votes, frame)
            masks.append((name, mask))
        return replace(merge_masks(masks, self._graph.targets, frame), known_objects=self.known_objects)

    def _observe(
        self, frame: Frame, depth_m: Float32[ndarray, "h w"], detections: Sequence[Detection]
    ) -> list[tuple[Landmark, Bool[ndarray, "h w"]]]:
        """Add the detections to the object map; return the masks of its landmarks in this frame."""
        kept = self._drop_excluded(self._drop_generic_anchors(detections))
        localised = [
            (detection, self._filter.with_support(observation, detection, frame))
            for detection, observation in lift_detections(kept, depth_m, frame)
            if self._filter.is_possible(observation)
        ]
        self._filter.observe_floor(frame)
        self._filter.observe([observation for _, observation in localised], VisibilityCheck(frame, frame.depth_m))
        self._needs_observation = any(
            self._filter.needs_observation(observation) and self._filter.target_of(observation) is not None
            for _, observation in localised
        )
        owners = [(self._filter.landmark_of(observation), detection.mask) for detection, observation in localised]
        return [(landmark, mask) for landmark, mask in owners if landmark is not None]

    def _drop_generic_anchors(self, detections: Sequence[Detection]) -> list[Detection]:
        """Drop detections of a generic noun that are an anchor: "the object on the desk" is not the desk."""
        nouns = {noun_of(anchor) for anchor in self._graph.anchors}
        anchors = [each.mask for each in detections if each.phrase in nouns and not each.is_weak]
        return [
            each
            for each in detections
            if not (is_generic(each.phrase) and any(each.mask is anchor for anchor in anchors))
        ]

    def _drop_excluded(self, detections: Sequence[Detection]) -> list[Detection]:
        """Remove the pixels of excluded objects from all others; drop detections that mostly show an excluded one."""
        nouns = self._graph.excluded_nouns
        excluded = [each.mask for each in detections if each.phrase in nouns and not each.is_weak]
        if not excluded:
            return list(detections)
        left_out = np.logical_or.reduce(excluded)
        others = [replace(each, mask=each.mask & ~left_out) for each in detections if each.phrase not in nouns]
        full = [each.mask for each in detections if each.phrase not in nouns]
        return [
            each
            for each, mask in zip(others, full, strict=True)
            if np.count_nonzero(each.mask) >= _MIN_SHARE_LEFT * np.count_nonzero(mask)
        ]


def merge_detections(detections: Sequence[Detection], targets: Sequence[str], frame: Frame) -> RelevanceMap:
    """Return the binary w(u, v) of detections whose phrases are targets."""
    return merge_masks([(each.phrase, each.mask) for each in detections], targets, frame)


def merge_masks(
    masks: Sequence[tuple[str, Bool[ndarray, "h w"]]], targets: Sequence[str], frame: Frame
) -> RelevanceMap:
    """Return the binary w(u, v): 1 on every target's mask; in an overlap the pixel belongs to the smaller object."""
    target = np.full(frame.depth_m.shape, NO_TARGET, np.int16)
    for name, mask in sorted(masks, key=lambda each: int(np.count_nonzero(each[1])), reverse=True):
        target[mask] = targets.index(name)
    return RelevanceMap((target != NO_TARGET).astype(np.float32), target)
