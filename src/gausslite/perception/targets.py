"""Select the landmarks that a task means: by noun, relations, attributes and scores."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.domain.objects import ObjectRole
from gausslite.domain.task import TaskGraph, noun_of
from gausslite.perception.object_map import Landmark, Observation
from gausslite.perception.relations import NamedObjects, RelationFilter
from gausslite.perception.selector import Fit


class TargetSelector:
    """Which landmarks are the task's targets, of all objects seen so far, whether in view or not."""

    def __init__(self, graph: TaskGraph, objects: NamedObjects) -> None:
        """The objects are shared with their owner, which observes frames."""
        self._graph = graph
        nouns = dict.fromkeys(noun_of(target) for target in graph.targets)
        self._names = {noun: [target for target in graph.targets if noun_of(target) == noun] for noun in nouns}
        self._objects = objects
        self._selector = objects.selector
        self._relations = RelationFilter(graph, objects, objects.selector)
        self.excluded_m: Float64[ndarray, "n 3"] = np.zeros((0, 3))
        """Points on objects that a person has excluded."""

    def select(self, T_world_camera: Float64[ndarray, "4 4"]) -> list[tuple[Landmark, str]]:
        """Return the confirmed landmarks that satisfy the relations of a target, with the target's name.

        Those whose scores are far below that of another are left out. A superlative selects one of the others, before
        those are left out that are no longer present. T_world_camera: the viewpoint of relations such as left_of.
        """
        evidence, chosen = self._objects.evidence, []
        for target, candidates in self._candidates(T_world_camera).items():
            selected = self._selector.select(target, evidence.without_low_scores(candidates), T_world_camera)
            chosen += [(landmark, target) for landmark in selected if evidence.is_present(landmark)]
        return chosen

    def target_of(self, observation: Observation) -> str | None:
        """Return the target that an observation shows: its noun, attributes and relations fit; None if there is none.

        The first target whose attributes are sure counts, else the first.
        """
        fits = {
            name: fit
            for name in self._names.get(observation.phrase, ())
            if (fit := self._selector.fit(name, observation.measured)) is not Fit.NO
            and self._relations.satisfies(name, observation)
        }
        if not fits or self._selector.is_excluded(observation.phrase, observation.measured):
            return None
        return next((name for name, fit in fits.items() if fit is Fit.YES), next(iter(fits)))

    def role(self, landmark: Landmark) -> ObjectRole:
        """Return what an object is to the task, by all that was seen so far.

        An object that was marked before its anchor was seen may turn out to be another one than the task means. Without
        a viewpoint, sides are evaluated as near.
        """
        observation = replace(landmark.seen_from(np.zeros(3)), camera_m=None)
        if self._is_meant(landmark) and (self._given_name(landmark) or self.target_of(observation) is not None):
            return ObjectRole.TARGET
        is_anchor = landmark.phrase in map(noun_of, self._graph.anchors) or landmark.phrase not in self._names
        return ObjectRole.ANCHOR if is_anchor else ObjectRole.OTHER

    def notes(self, T_world_camera: Float64[ndarray, "4 4"] | None) -> tuple[str, ...]:
        """Return what attributes and scores decided, and unseen anchors; T_world_camera: the latest viewpoint."""
        objects = self._objects.object_map.objects
        rivals = ((landmark.phrase, self._objects.evidence.rival(landmark)) for landmark in objects)
        low_scores = {} if T_world_camera is None else self._low_score_counts(T_world_camera)
        unseen = dict.fromkeys(map(self._selector.label, self._relations.unseen_anchors))
        return (
            *self._selector.notes(self._objects.evidence.confirmed(objects), self._objects),
            *dict.fromkeys(
                f"what looks like {noun!r} is rather {rival!r}: not activated; --accept-similar accepts it"
                for noun, rival in rivals
                if rival is not None
            ),
            *(
                f"{target!r}: {count} scored far below the best, so not activated; --accept-similar accepts all"
                for target, count in low_scores.items()
            ),
            *(f"anchor {name!r} not seen yet: its targets are kept" for name in unseen),
        )

    def _low_score_counts(self, T_world_camera: Float64[ndarray, "4 4"]) -> dict[str, int]:
        """Return how many objects of each target `select` leaves out for their scores, without targets of none."""
        counts = {
            target: len(candidates) - len(self._objects.evidence.without_low_scores(candidates))
            for target, candidates in self._candidates(T_world_camera).items()
        }
        return {target: count for target, count in counts.items() if count}

    def _candidates(self, T_world_camera: Float64[ndarray, "4 4"]) -> dict[str, list[Landmark]]:
        """Return the confirmed landmarks that satisfy the relations of each target."""
        confirmed = self._objects.evidence.confirmed(self._objects.object_map.objects)
        named = [
            (landmark, self._given_name(landmark) or self.target_of(landmark.seen_from(T_world_camera[:3, 3])))
            for landmark in confirmed
            if self._is_meant(landmark) and not self.is_excluded(landmark)
        ]
        return {target: [landmark for landmark, name in named if name == target] for target in self._graph.targets}

    def is_excluded(self, landmark: Landmark) -> bool:
        """Return True if a person has excluded this object."""
        return any(landmark.contains(point_m) for point_m in self.excluded_m)

    def _is_meant(self, landmark: Landmark) -> bool:
        """Return False where people have said that no object of its noun is meant, unless they point at it."""
        is_there = self._selector.places.get(landmark.phrase)
        return landmark.is_given or is_there is None or is_there(landmark.centroid_m)

    def _given_name(self, landmark: Landmark) -> str | None:
        """Return the target of an object that a person has pointed at; None for other objects."""
        return next(iter(self._names.get(landmark.phrase, ())), None) if landmark.is_given else None
