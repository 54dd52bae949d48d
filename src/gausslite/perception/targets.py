"""Select the landmarks that a task means: by noun, colour, relations, scores and superlatives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.domain.objects import ObjectRole
from gausslite.domain.task import TaskGraph, noun_of
from gausslite.perception.colours import ColourMatch
from gausslite.perception.object_map import Landmark, Observation
from gausslite.perception.relations import NamedObjects, RelationFilter, select_extreme
from gausslite.perception.supporting_surface import SupportingSurfaces


class TargetSelector:
    """Which landmarks are the task's targets, of all objects seen so far, whether in view or not."""

    def __init__(
        self, graph: TaskGraph, objects: NamedObjects, relations: RelationFilter, surfaces: SupportingSurfaces
    ) -> None:
        """All but the graph are shared with their owner, which observes frames."""
        self._graph = graph
        nouns = dict.fromkeys(noun_of(target) for target in graph.targets)
        self._names = {noun: [target for target in graph.targets if noun_of(target) == noun] for noun in nouns}
        superlatives = {attributes.name: attributes.superlative for attributes in graph.attributes}
        self._superlatives = {target: superlatives.get(target) for target in graph.targets}
        self._objects = objects
        self._relations = relations
        self._surfaces = surfaces
        self.excluded_m: Float64[ndarray, "n 3"] = np.zeros((0, 3))
        """Points on objects that a person has excluded."""

    def select(self, T_world_camera: Float64[ndarray, "4 4"]) -> list[tuple[Landmark, str]]:
        """Return the confirmed landmarks that satisfy the relations of a target, with the target's name.

        Those whose scores are far below that of another are left out. A superlative selects one of the others, before
        those are left out that are no longer present. T_world_camera: the viewpoint of relations such as left_of.
        """
        evidence, chosen = self._objects.evidence, []
        for target, candidates in self._candidates(T_world_camera).items():
            selected, superlative = evidence.without_low_scores(candidates), self._superlatives[target]
            if selected and superlative is not None:
                selected = [select_extreme(selected, superlative, self._surfaces.up, T_world_camera)]
            chosen += [(landmark, target) for landmark in selected if evidence.is_present(landmark)]
        return chosen

    def target_of(self, observation: Observation) -> str | None:
        """Return the target that an observation shows: its noun, colour and relations fit; None if there is none.

        The first target whose colour is sure counts, else the first.
        """
        colours = self._objects.colours
        names = [
            name
            for name in self._names.get(observation.phrase, ())
            if colours.allows(name, observation.colours) and self._relations.satisfies(name, observation)
        ]
        if not names or colours.is_excluded(observation.phrase, observation.colours):
            return None
        sure = (name for name in names if colours.match(name, observation.colours) is ColourMatch.YES)
        return next(sure, names[0])

    def role(self, landmark: Landmark) -> ObjectRole:
        """Return what an object is to the task, by all that was seen so far.

        An object that was marked before its anchor was seen may turn out to be another one than the task means. Without
        a viewpoint, sides are evaluated as near.
        """
        observation = replace(landmark.seen_from(np.zeros(3)), camera_m=None)
        if self._given_name(landmark) or self.target_of(observation) is not None:
            return ObjectRole.TARGET
        is_anchor = landmark.phrase in map(noun_of, self._graph.anchors) or landmark.phrase not in self._names
        return ObjectRole.ANCHOR if is_anchor else ObjectRole.OTHER

    def notes(self, T_world_camera: Float64[ndarray, "4 4"] | None) -> tuple[str, ...]:
        """Return what colours, heights and scores decided, and unseen anchors; T_world_camera: the latest viewpoint."""
        objects = self._objects.object_map.objects
        confirmed = self._objects.evidence.confirmed(objects)
        rivals = ((landmark.phrase, self._objects.evidence.rival(landmark)) for landmark in objects)
        low_scores = {} if T_world_camera is None else self._low_score_counts(T_world_camera)
        unseen = dict.fromkeys(map(self._objects.colours.label, self._relations.unseen_anchors))
        return (
            *self._objects.colours.notes([(landmark.phrase, landmark.colours) for landmark in confirmed]),
            *self._height_notes(confirmed),
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

    def _height_notes(self, confirmed: list[Landmark]) -> list[str]:
        """Return which relations heights decide, for how many of the objects, and what happens to the others."""
        relations = {
            (relation.target, relation.anchor): relation
            for relation in self._graph.relations
            if self._surfaces.is_by_height(relation)
        }
        notes = []
        for relation in relations.values():
            noun, anchor = noun_of(relation.target), noun_of(relation.anchor)
            seen = [landmark for landmark in confirmed if landmark.phrase == noun]
            sure = sum(self._surfaces.stands_on(relation, landmark) is not None for landmark in seen)
            others = "compared with the class detected instead" if self._objects.seen(relation.anchor) else "kept"
            others = "left out" if others == "kept" and relation.negated else others
            notes.append(
                f"no class of the detector is a {anchor!r}: the height of what an object stands on decides, so far "
                f"for {sure} of {len(seen)} {noun!r} objects; the others are {others}"
            )
        return notes

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
            if not self.is_excluded(landmark)
        ]
        return {target: [landmark for landmark, name in named if name == target] for target in self._superlatives}

    def is_excluded(self, landmark: Landmark) -> bool:
        """Return True if a person has excluded this object."""
        return any(landmark.contains(point_m) for point_m in self.excluded_m)

    def _given_name(self, landmark: Landmark) -> str | None:
        """Return the target of an object that a person has pointed at; None for other objects."""
        return next(iter(self._names.get(landmark.phrase, ())), None) if landmark.is_given else None
