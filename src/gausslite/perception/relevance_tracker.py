"""Decide the relevance of each frame: which pixels show the task's targets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Float64
from numpy import ndarray
from numpy.typing import NDArray

from gausslite.domain.errors import InvalidInputError, MapFileError
from gausslite.domain.frame import Frame
from gausslite.domain.objects import NounMatch, NounReport, ObjectLandmark
from gausslite.domain.pose import require_rigid, rotation_angle_deg, translation_m, unit_up_axis
from gausslite.domain.relevance import NO_TARGET, Detection, PointM, RelevanceMap
from gausslite.domain.state import (
    State,
    add_prefix,
    encode_text,
    get_array,
    get_counts,
    get_floats,
    get_text,
    int_array,
    select_prefix,
)
from gausslite.domain.task import TaskGraph, noun_of
from gausslite.nouns import is_generic
from gausslite.perception.detector import bounding_box
from gausslite.perception.evidence import Evidence, LandmarkState, VisibilityCheck
from gausslite.perception.lifting import lift_detections
from gausslite.perception.object_map import (
    INDEPENDENT_NS,
    MAX_OBJECTS,
    Landmark,
    Measured,
    ObjectMap,
    Observation,
    describe_landmarks,
)
from gausslite.perception.relations import NamedObjects
from gausslite.perception.selector import open_selector
from gausslite.perception.settings import RelevanceTrackerSettings
from gausslite.perception.surface import VOXEL_SIZES_M, SurfaceVotes, refined_mask, surface_mask
from gausslite.perception.targets import TargetSelector

_MIN_LEFT_SHARE = 0.3
"""Share of a detection outside excluded objects, below which it shows one of them."""
_MIN_SHOWN_SHARE = 0.5
"""Share of a known object's surface in a frame's relevance, from which the frame needs no completion."""


class RelevanceTracker:
    """State of the tracked targets: latest keyframe, landmarks with their surfaces. Use from one thread at a time.

    The caller runs the detector. Detections are localised in 3D and filtered by the task's relations. The masks of all
    frames follow from the measured surfaces of the objects.
    """

    def __init__(self, graph: TaskGraph, settings: RelevanceTrackerSettings, matches: Sequence[NounMatch] = ()) -> None:
        """matches: what the detector searches for the graph's nouns. Raises MissingPluginError."""
        self._graph = graph
        self._settings = settings
        self._evidence = Evidence(settings.evidence)
        self._object_map = ObjectMap()
        up = self._up = np.array(unit_up_axis(settings.up_axis))
        self._selector = open_selector(graph, matches, up)
        self._targets = TargetSelector(graph, NamedObjects(self._object_map, self._evidence, self._selector))
        self._T_world_keyframe: Float64[ndarray, "4 4"] | None = None
        self._frames_since, self._keyframe_ns = 0, 0
        self._needs_observation = False
        self._known_targets: list[int] = []
        self._seen: dict[str, tuple[int, float, int]] = {}  # detections of a noun, its best score, in which frame

    @property
    def known_objects(self) -> int:
        """The number of targets that were known so far."""
        return len(self._known_targets)

    @property
    def notes(self) -> tuple[str, ...]:
        """What attributes decided, different things, low scores, and anchors that no frame has shown yet."""
        return self._targets.notes(self._T_world_keyframe)

    @property
    def landmarks(self) -> tuple[Landmark, ...]:
        """All objects detected so far for the task's nouns, in world coordinates."""
        return self._object_map.objects

    @property
    def objects(self) -> tuple[ObjectLandmark, ...]:
        """The confirmed objects of the task by their roles, without far lower scores, the most confident first."""
        confirmed = filter(self._evidence.is_witnessed, self._evidence.confirmed(self.landmarks))
        kept = [found for found in confirmed if not self._targets.is_excluded(found)]
        sure = self._evidence.without_low_scores(kept)
        return describe_landmarks([(found, self._targets.role(found)) for found in sure])

    def report(self, match: NounMatch) -> NounReport:
        """Return what has been detected of a noun so far."""
        landmarks = self._object_map.with_phrase(match.noun)
        detections, best_score, best_frame = self._seen.get(match.noun, (0, 0.0, None))
        rival = next(filter(None, map(self._evidence.rival, landmarks)), None)
        count = sum(found.noun == match.noun for found in self.objects)
        return NounReport(match, detections, best_score, count, rival, best_frame)

    def state(self) -> State:
        """Return the landmarks and the keyframe's pose as named arrays."""
        pose = np.zeros((0, 4, 4)) if self._T_world_keyframe is None else self._T_world_keyframe[None]
        state: dict[str, NDArray[Any]] = {
            "T_world_keyframe": pose,
            "keyframe_age": int_array(self._frames_since, self._keyframe_ns, self._needs_observation),
            "known_targets": int_array(*self._known_targets),
        }
        state |= self._selector.state()
        state["seen_nouns"] = encode_text("\n".join(self._seen))
        state["seen_counts"] = int_array(*(number for n, _, i in self._seen.values() for number in (n, i)))
        state["seen_scores"] = np.array([score for _, score, _ in self._seen.values()])
        state["excluded_m"] = self._targets.excluded_m
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
        self._targets.excluded_m = get_array(state, "excluded_m", (None, 3), np.float64).copy()
        nouns = get_text(state, "seen_nouns").splitlines()
        counts, scores = get_counts(state, "seen_counts", 2 * len(nouns)), get_floats(state, "seen_scores", len(nouns))
        self._seen = dict(zip(nouns, zip(counts[::2], scores, counts[1::2], strict=True), strict=True))
        self._selector.restore(state)
        self._object_map.restore([decode_landmark(saved, self._selector.decode(saved)) for saved in saved_landmarks])
        self._T_world_keyframe = poses[0].copy() if len(poses) else None
        self._frames_since, self._keyframe_ns, needs_observation = get_counts(state, "keyframe_age", 3)
        self._needs_observation = needs_observation > 0
        self._known_targets = list(get_counts(state, "known_targets", len(state.get("known_targets", ()))))

    def point_at(self, noun: str, mask: Bool[ndarray, "h w"], frame: Frame) -> None:
        """Add the object that a person points at: its mask on a frame. It is meant again if it was excluded.

        Raises InvalidInputError for a mask with too little depth, or of a plane where the noun's kind is none.
        """
        detection = Detection(noun, 1.0, bounding_box(mask) or (0.0, 0.0, 0.0, 0.0), mask, is_exact=True)
        lifted = lift_detections([detection], frame.depth_m, frame, self._up)
        if not lifted:
            raise InvalidInputError(f"pointed object: expected a {noun!r} with depth on frame {frame.index}, got none")
        ((_, observation),) = self._measured(lifted, frame)
        self._object_map.observe([observation])
        landmark = self._object_map.match(observation)
        assert landmark is not None
        landmark.is_given = True
        left = [point_m for point_m in self._targets.excluded_m if not landmark.contains(point_m)]
        self._targets.excluded_m = np.array(left).reshape(-1, 3)

    def exclude(self, point_m: PointM) -> None:
        """Leave out the object at a point, now and when it is detected again. Raises InvalidInputError for too many."""
        if len(self._targets.excluded_m) == MAX_OBJECTS:
            raise InvalidInputError(f"excluded: expected at most {MAX_OBJECTS} points, got more")
        self._targets.excluded_m = np.vstack([self._targets.excluded_m, point_m])

    def update_keyframe(self, frame: Frame) -> bool:
        """Return whether this frame needs a detection, and make it the keyframe if so.

        Keyframes are the first frame, every max_frames-th frame, a frame far from the keyframe, and the first one that
        is another witness of a target that the keyframe shows.
        """
        T_world_keyframe = self._T_world_keyframe
        self._frames_since += 1
        is_keyframe = (
            T_world_keyframe is None
            or self._frames_since >= self._settings.max_frames  # objects move, and a still robot would never look
            or (self._needs_observation and frame.capture_time_ns - self._keyframe_ns >= INDEPENDENT_NS)
            or translation_m(T_world_keyframe, frame.T_world_camera) > self._settings.max_translation_m
            or rotation_angle_deg(T_world_keyframe, frame.T_world_camera) > self._settings.max_rotation_deg
        )
        if is_keyframe:
            self._T_world_keyframe, self._frames_since = frame.T_world_camera, 0
            self._keyframe_ns = frame.capture_time_ns
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
        missed = [
            (name, mask)
            for landmark, name in self._targets.select(self._viewpoint(frame))
            if landmark.number in new
            and np.count_nonzero((mask := surface_mask(landmark.votes, frame)) & relevance.roi)
            < _MIN_SHOWN_SHARE * np.count_nonzero(mask)
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
        for landmark, name in self._targets.select(self._viewpoint(frame)):
            # once known, always: earlier keyframes have its mask by now
            if landmark.number not in self._known_targets and self._evidence.state(landmark) is LandmarkState.KNOWN:
                self._known_targets.append(landmark.number)
            own = [mask for owner, mask in detected if owner is landmark]
            if own:
                # a detected mask is exact at its border
                mask = refined_mask(np.logical_or.reduce(own), landmark.votes, frame)
            else:
                mask = surface_mask(landmark.votes, frame)
            masks.append((name, mask))
        return replace(merge_masks(masks, self._graph.targets, frame), known_objects=self.known_objects)

    def _observe(
        self, frame: Frame, depth_m: Float32[ndarray, "h w"], detections: Sequence[Detection]
    ) -> list[tuple[Landmark, Bool[ndarray, "h w"]]]:
        """Add the detections to the object map; return the masks of its landmarks in this frame."""
        for box in detections:
            n, best, at = self._seen.get(box.phrase, (0, 0.0, frame.index))
            self._seen[box.phrase] = (n + (not box.is_weak), *max((best, at), (box.score, frame.index)))
        excluded = self._excluded_pixels(detections, frame)
        kept = self._drop_excluded(self._drop_generic_anchors(detections), excluded)
        depth_m = np.where(excluded, np.float32(0.0), depth_m)  # no other object may grow onto it
        localised = self._measured(lift_detections(kept, depth_m, frame, self._up), frame)
        self._selector.observe(frame)  # before relations are evaluated: a selector may need the image
        visibility = VisibilityCheck(frame, frame.depth_m)
        # what this frame should show and does not is counted too: a ghost disappears by that
        self._object_map.observe([observation for _, observation in localised], visibility.is_visible)
        shown = [
            (landmark, detection.mask, observation)
            for detection, observation in localised
            if (landmark := self._object_map.match(observation)) is not None
        ]
        self._needs_observation = any(
            not self._evidence.is_witnessed(landmark) and self._targets.target_of(observation) is not None
            for landmark, _, observation in shown
        )
        return [(landmark, mask) for landmark, mask, _ in shown]

    def _measured(
        self, lifted: Sequence[tuple[Detection, Observation]], frame: Frame
    ) -> list[tuple[Detection, Observation]]:
        """Return the observations with the attributes that their masks show."""
        return [
            (detection, replace(found, measured=self._selector.measured(found, detection.mask, frame)))
            for detection, found in lifted
        ]

    def _drop_generic_anchors(self, detections: Sequence[Detection]) -> list[Detection]:
        """Drop detections of a generic noun that are an anchor: "the object on the desk" is not the desk."""
        nouns = {noun_of(anchor) for anchor in self._graph.anchors}
        anchors = [detection.mask for detection in detections if detection.phrase in nouns and not detection.is_weak]
        return [
            detection
            for detection in detections
            if not (is_generic(detection.phrase) and any(detection.mask is anchor for anchor in anchors))
        ]

    def _excluded_pixels(self, detections: Sequence[Detection], frame: Frame) -> Bool[ndarray, "h w"]:
        """Return the pixels of excluded objects, which belong to no other."""
        pixels = np.zeros(frame.depth_m.shape, np.bool_)
        for detection in detections:
            if detection.phrase in self._graph.excluded_nouns and not detection.is_weak:
                pixels |= detection.mask
        return pixels

    def _drop_excluded(self, detections: Sequence[Detection], excluded: Bool[ndarray, "h w"]) -> list[Detection]:
        """Remove the excluded pixels from all detections; drop those that mostly show an excluded object."""
        kept = []
        for detection in detections:
            left = detection.mask & ~excluded
            is_other = np.count_nonzero(left) > _MIN_LEFT_SHARE * np.count_nonzero(detection.mask)
            if detection.phrase not in self._graph.excluded_nouns and is_other:
                kept.append(replace(detection, mask=left))
        return kept


def merge_masks(
    masks: Sequence[tuple[str, Bool[ndarray, "h w"]]], targets: Sequence[str], frame: Frame
) -> RelevanceMap:
    """Return the binary w(u, v): 1 on every target's mask; in an overlap the pixel belongs to the smaller object."""
    target = np.full(frame.depth_m.shape, NO_TARGET, np.int16)
    # largest first: the smaller object overwrites it
    for name, mask in sorted(masks, key=lambda named: int(np.count_nonzero(named[1])), reverse=True):
        target[mask] = targets.index(name)
    return RelevanceMap((target != NO_TARGET).astype(np.float32), target)


def encode_landmark(landmark: Landmark) -> dict[str, NDArray[Any]]:
    """Encode a landmark."""
    return {
        "phrase": encode_text(landmark.phrase),
        "centroid_radius_m": np.array([*landmark.centroid_m, landmark.radius_m]),
        "cells": landmark.cells,
        "counts": landmark.counts,
        "seen_missed": int_array(landmark.seen_count, landmark.missed_count, landmark.missed_in_a_row),
        "weak_given": int_array(landmark.weak_count, landmark.is_given),
        "seen_ns_number": np.array([landmark.first_seen_ns, landmark.last_seen_ns, landmark.number], np.int64),
        "views": np.array([landmark.view_count, landmark.view_ns], np.int64),
        "view_camera_m": np.zeros((0, 3)) if landmark.view_camera_m is None else landmark.view_camera_m[None],
        "best_score_farthest_m": np.array([landmark.best_score, landmark.farthest_m]),
        "rival_names": encode_text("\n".join(landmark.rival_scores)),
        "vote_keys": landmark.votes.keys,
        "votes": np.stack([landmark.votes.inside, landmark.votes.outside]),
        "vote_voxel_m": np.array([landmark.votes.voxel_m]),
        "score_sums": np.array([landmark.score_sum, *landmark.rival_scores.values()]),
        **({} if landmark.measured is None else landmark.measured.state()),
    }


def decode_landmark(state: State, measured: Measured | None) -> Landmark:
    """Decode a landmark with its attributes. Raises MapFileError, InvalidInputError."""
    x_m, y_m, z_m, radius_m = get_floats(state, "centroid_radius_m", 4)
    cells = get_array(state, "cells", (None,), np.int64).copy()
    counts = get_array(state, "counts", cells.shape, np.int64).copy()
    if (counts < 1).any() or (cells[1:] <= cells[:-1]).any() or len(cells) == 0:
        raise MapFileError("state landmark: expected ascending cells with positive counts, got others")
    seen_count, missed_count, missed_in_a_row = get_counts(state, "seen_missed", 3)
    if not seen_count:
        raise MapFileError("state seen_missed: expected an object that was seen at least once")
    weak_count, is_given = get_counts(state, "weak_given", 2)
    best_score, farthest_m = get_floats(state, "best_score_farthest_m", 2)
    first_ns, last_ns, number = (int(value) for value in get_array(state, "seen_ns_number", (3,), np.int64))
    view_count, view_ns = (int(value) for value in get_array(state, "views", (2,), np.int64))
    view_camera_m = next(iter(get_array(state, "view_camera_m", (None, 3), np.float64).copy()), None)
    keys = get_array(state, "vote_keys", (None,), np.int64).copy()
    inside, outside = get_array(state, "votes", (2, len(keys)), np.int64).copy()
    if (keys[1:] <= keys[:-1]).any() or (inside < 0).any() or (outside < 0).any():
        raise MapFileError("state landmark: expected ascending voxels with votes, got others")
    (voxel_m,) = get_floats(state, "vote_voxel_m", 1)
    if voxel_m not in VOXEL_SIZES_M:
        raise MapFileError(f"state landmark: expected voxels of {', '.join(map(str, VOXEL_SIZES_M))} m, got {voxel_m}")
    names = get_text(state, "rival_names").splitlines()
    score_sum, *rival_sums = get_floats(state, "score_sums", 1 + len(names))
    return Landmark(
        phrase=get_text(state, "phrase"),
        centroid_m=np.array([x_m, y_m, z_m]),
        radius_m=radius_m,
        cells=cells,
        counts=counts,
        seen_count=seen_count,
        missed_count=missed_count,
        best_score=best_score,
        farthest_m=farthest_m,
        first_seen_ns=first_ns,
        last_seen_ns=last_ns,
        number=number,
        view_count=view_count,
        view_camera_m=view_camera_m,
        view_ns=view_ns,
        score_sum=score_sum,
        rival_scores=dict(zip(names, rival_sums, strict=True)),
        votes=SurfaceVotes(keys, inside, outside, voxel_m),
        missed_in_a_row=missed_in_a_row,
        weak_count=weak_count,
        is_given=is_given > 0,
        measured=measured,
    )
