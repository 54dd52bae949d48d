"""Describe landmarks for a report: noun, role in the task, place, extent, confidence and times."""

from __future__ import annotations

from collections.abc import Sequence

from gausslite.domain.objects import MAX_OBJECTS_PER_AGENT, ObjectLandmark, ObjectRole
from gausslite.domain.task import TaskGraph, noun_of
from gausslite.perception.object_map import Landmark


def describe_landmarks(landmarks: Sequence[Landmark], graph: TaskGraph) -> tuple[ObjectLandmark, ...]:
    """Return the landmarks as values, in their order; of too many for a report, the most confident ones."""
    described = [describe_landmark(each, graph) for each in landmarks]
    chosen = sorted(described, key=lambda each: -each.confidence)[:MAX_OBJECTS_PER_AGENT]
    ids = {each.object_id for each in chosen}
    return tuple(each for each in described if each.object_id in ids)


def describe_landmark(landmark: Landmark, graph: TaskGraph) -> ObjectLandmark:
    """Return a landmark as a value; its confidence is the best score times the share of frames that detected it."""
    x, y, z = (float(value) for value in landmark.centroid_m)
    seen_share = landmark.seen_count / (landmark.seen_count + landmark.missed_count)
    return ObjectLandmark(
        f"{landmark.phrase}-{landmark.number}",
        landmark.phrase,
        ObjectRole.TARGET if landmark.phrase in map(noun_of, graph.targets) else ObjectRole.ANCHOR,
        (x, y, z),
        landmark.box_m(),
        min(max(landmark.best_score, 0.0), 1.0) * seen_share,
        landmark.first_seen_ns,
        landmark.last_seen_ns,
    )
