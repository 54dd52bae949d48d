"""Filter detections by the task's spatial relations (Sec. III-B.3) and colours."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.domain.frame import Frame
from gausslite.domain.object_names import has_back
from gausslite.domain.pose import UpAxis, unit_up_axis
from gausslite.domain.relevance import Detection
from gausslite.domain.task import Predicate, Relation, TaskGraph, noun_of
from gausslite.perception.colour_filter import ColourFilter
from gausslite.perception.colours import ColourMatch
from gausslite.perception.evidence import EvidenceSettings, VisibilityCheck
from gausslite.perception.object_map import Landmark, ObjectMap, Observation
from gausslite.perception.relations import RelationGeometry, SpatialSettings, surface_distance_m
from gausslite.perception.superlatives import select_extreme
from gausslite.perception.supporting_surface import FloorLevel, stands_on, support_level_m


class SpatialFilter:
    """Evaluate the graph's relations and colours against all objects seen so far, whether in view or not."""

    def __init__(
        self,
        graph: TaskGraph,
        up_axis: UpAxis,
        settings: SpatialSettings,
        evidence: EvidenceSettings | None = None,
        nouns_by_height: frozenset[str] = frozenset(),
    ) -> None:
        """nouns_by_height: surfaces that no detection shows; heights decide what stands on them."""
        self._relations = {
            target: tuple(relation for relation in graph.relations if relation.target == target)
            for target in graph.targets
        }
        nouns = dict.fromkeys(noun_of(target) for target in graph.targets)
        self._names = {noun: tuple(each for each in graph.targets if noun_of(each) == noun) for noun in nouns}
        superlatives = {each.name: each.superlative for each in graph.attributes}
        self._superlatives = {target: superlatives.get(target) for target in graph.targets}
        self._colours = ColourFilter(graph)
        self._up = np.array(unit_up_axis(up_axis))
        self._geometry = RelationGeometry(self._up, settings)
        self._evidence = evidence or EvidenceSettings()
        self._object_map = ObjectMap()
        self._nouns_by_height = frozenset(
            noun_of(each.anchor) for each in graph.relations if each.predicate is Predicate.ON
        ).intersection(nouns_by_height)
        self._floor = FloorLevel.before_frames()

    @property
    def landmarks(self) -> tuple[Landmark, ...]:
        """Every object seen so far."""
        return self._object_map.objects

    @property
    def confirmed_landmarks(self) -> tuple[Landmark, ...]:
        """The objects that have enough evidence to exist."""
        return tuple(each for each in self._object_map.objects if self._evidence.is_confirmed(each))

    @property
    def rivals(self) -> tuple[tuple[Landmark, str], ...]:
        """The landmarks that rather show a different thing, with its name."""
        rivals = ((each, self._evidence.rival(each)) for each in self._object_map.objects)
        return tuple((each, rival) for each, rival in rivals if rival is not None)

    @property
    def unseen_anchors(self) -> tuple[str, ...]:
        """Anchors of relations that no frame has shown yet, with their colours."""
        needed = dict.fromkeys(
            each.anchor for relations in self._relations.values() for each in relations if not self._is_by_height(each)
        )
        return tuple(dict.fromkeys(self._colours.label(name) for name in needed if not self._landmarks_of(name)))

    @property
    def colour_notes(self) -> tuple[str, ...]:
        """What the colours of the task decided about the confirmed objects, and where they could not."""
        return self._colours.notes(self.confirmed_landmarks)

    @property
    def height_notes(self) -> tuple[str, ...]:
        """Which relations heights decide, for how many of the confirmed objects, and what happens to the others."""
        relations = [each for relations in self._relations.values() for each in relations if self._is_by_height(each)]
        notes = []
        for relation in {(each.target, each.anchor): each for each in relations}.values():
            noun, anchor = noun_of(relation.target), noun_of(relation.anchor)
            seen = [each for each in self.confirmed_landmarks if each.phrase == noun]
            sure = sum(self._stands_on(relation, each) is not None for each in seen)
            others = "compared with the class detected instead" if self._landmarks_of(relation.anchor) else "kept"
            others = "left out" if others == "kept" and relation.negated else others
            notes.append(
                f"no class of the detector is a {anchor!r}: the height of what an object stands on decides, so far "
                f"for {sure} of {len(seen)} {noun!r} objects; the others are {others}"
            )
        return tuple(notes)

    @property
    def floor(self) -> FloorLevel:
        """The points observed so far, by their height; none if no relation needs them."""
        return self._floor

    def is_possible(self, observation: Observation) -> bool:
        """Return False for a seat with a back that is flat: detectors take rugs and screens for chairs."""
        is_flat = observation.is_flat(self._up) or observation.is_panel(self._up)
        return not (is_flat and has_back(observation.phrase))

    def with_support(self, observation: Observation, detection: Detection, frame: Frame) -> Observation:
        """Return the observation with the level of the plane under it, if a relation needs it."""
        if not self._nouns_by_height:
            return observation
        level_m = support_level_m(detection.mask, frame, self._up)
        return replace(observation, supports_m=np.array([level_m])) if np.isfinite(level_m) else observation

    def observe_floor(self, frame: Frame) -> None:
        """Count a frame's points by their height, if a relation needs the floor."""
        if self._nouns_by_height:
            self._floor = self._floor.add(frame, self._up)

    def observe(self, observations: Sequence[Observation], visibility: VisibilityCheck | None = None) -> None:
        """Add one frame's observations to the object map; `visibility` also counts the landmarks that it missed."""
        self._object_map.observe(observations, None if visibility is None else visibility.is_visible)

    def is_confirmed(self, observation: Observation) -> bool:
        """Return True if the observed object has enough evidence to exist."""
        landmark = self._object_map.match(observation)
        return landmark is not None and self._evidence.is_confirmed(landmark)

    def targets(self, T_world_camera: Float64[ndarray, "4 4"]) -> list[tuple[Landmark, str]]:
        """Return the confirmed landmarks that satisfy the relations of a target, with the target's name.

        A superlative selects one of them, before those are left out that are no longer present. Those whose scores are
        far below that of another are left out too. T_world_camera: the viewpoint of relations such as left_of.
        """
        chosen = []
        for target, candidates in self._candidates(T_world_camera).items():
            selected, superlative = self._evidence.without_low_scores(candidates), self._superlatives[target]
            if selected and superlative is not None:
                reliable = [each for each in selected if self._evidence.is_reliable(each)]
                selected = [select_extreme(reliable or selected, superlative, self._up, T_world_camera)]
            chosen += [(landmark, target) for landmark in selected if self._evidence.is_present(landmark)]
        return chosen

    def low_score_counts(self, T_world_camera: Float64[ndarray, "4 4"]) -> dict[str, int]:
        """Return how many objects of each target `targets` leaves out for their scores, without targets of none."""
        counts = {
            target: len(candidates) - len(self._evidence.without_low_scores(candidates))
            for target, candidates in self._candidates(T_world_camera).items()
        }
        return {target: count for target, count in counts.items() if count}

    def _candidates(self, T_world_camera: Float64[ndarray, "4 4"]) -> dict[str, list[Landmark]]:
        """Return the confirmed landmarks that satisfy the relations of each target."""
        named = [(each, self.target_of(each.seen_from(T_world_camera[:3, 3]))) for each in self.confirmed_landmarks]
        return {target: [landmark for landmark, name in named if name == target] for target in self._superlatives}

    def landmark_of(self, observation: Observation) -> Landmark | None:
        """Return the landmark that an observation shows."""
        return self._object_map.match(observation)

    def needs_observation(self, observation: Observation) -> bool:
        """Return True if one more observation could confirm the object."""
        landmark = self._object_map.match(observation)
        return landmark is not None and self._evidence.needs_observation(landmark)

    def restore(self, landmarks: Sequence[Landmark], floor: FloorLevel) -> None:
        """Replace the object map by these landmarks, oldest first, and the floor."""
        self._object_map, self._floor = ObjectMap(landmarks), floor

    def target_of(self, observation: Observation) -> str | None:
        """Return the target that an observation shows: its noun, colour and relations fit; None if there is none.

        The first target whose colour is sure counts, else the first.
        """
        names = [
            name
            for name in self._names.get(observation.phrase, ())
            if self._colours.allows(name, observation) and self._satisfies(self._relations[name], observation)
        ]
        if not names or self._colours.is_excluded(observation):
            return None
        return next((name for name in names if self._colours.match(name, observation) is ColourMatch.YES), names[0])

    def _satisfies(self, relations: Sequence[Relation], observation: Observation) -> bool:
        """Return True if no negated relation holds, and any other does (Sec. III-B.3) or none can be evaluated.

        Relations to anchors that were never seen in their colour are not evaluated. Of negated relations that heights
        decide, only the sure ones hold. All the anchors of `between` form one relation.
        """
        seen = [
            each
            for each in relations
            if self._stands_on(each, observation) is not None or self._landmarks_of(each.anchor)
        ]
        if any(each.negated and self._is_by_height(each) and each not in seen for each in relations):
            return False
        simple = [each for each in seen if each.predicate is not Predicate.BETWEEN]
        if any(each.negated and self._holds(each, observation) for each in simple):
            return False
        results = [self._holds(each, observation) for each in simple if not each.negated]
        for negated in (False, True):
            anchors = [
                self._anchors(each, observation)
                for each in relations
                if each.predicate is Predicate.BETWEEN and each.negated == negated
            ]
            between = self._geometry.between(observation, anchors) if anchors else None
            if between is not None and negated and between:
                return False
            if between is not None and not negated:
                results.append(between)
        return not results or any(results)

    def _anchors(self, relation: Relation, observation: Observation) -> list[Landmark]:
        """Return the relation's anchors without the target itself."""
        landmarks = self._confirmed_landmarks(relation.anchor)
        return [each for each in landmarks if not each.may_equal(observation)]

    def _holds(self, relation: Relation, observation: Observation) -> bool:
        """Return whether the relation holds, regardless of its negation."""
        by_height = self._stands_on(relation, observation)
        if by_height is not None:
            return by_height
        if relation.predicate in (Predicate.CLOSEST_TO, Predicate.FARTHEST_FROM):
            return self._is_extreme(relation, observation)
        anchors = self._anchors(relation, observation)
        has_bounds = relation.min_m is not None or relation.max_m is not None
        if has_bounds and not self._geometry.is_at_distance(relation, observation, anchors):
            return False
        if has_bounds and relation.predicate is Predicate.NEAR:
            return True
        geometry = self._geometry.with_reach(relation.max_m) if has_bounds else self._geometry
        return any(geometry.holds(relation.predicate, observation, anchor) for anchor in anchors)

    def _is_by_height(self, relation: Relation) -> bool:
        """Return True if heights decide the relation: on a surface without a colour that no detection shows."""
        noun = noun_of(relation.anchor)
        is_plain = self._colours.label(relation.anchor) == noun
        return relation.predicate is Predicate.ON and is_plain and noun in self._nouns_by_height

    def _stands_on(self, relation: Relation, seen: Landmark | Observation) -> bool | None:
        """Return whether an object stands on the relation's anchor by its height; None if heights do not decide."""
        if not self._is_by_height(relation):
            return None
        bottom_m = seen.votes.lowest_m(self._up)
        return stands_on(noun_of(relation.anchor), seen.supports_m, self._floor.level_m, bottom_m)

    def _is_extreme(self, relation: Relation, observation: Observation) -> bool:
        """Return True for the reliable candidate with the least (or largest) distance to its nearest anchor."""
        sign = 1.0 if relation.predicate is Predicate.CLOSEST_TO else -1.0
        anchors = self._confirmed_landmarks(relation.anchor)
        best, best_signed_m = None, np.inf
        for candidate in self._reliable_landmarks(relation.target):
            distances_m = [surface_distance_m(candidate, each) for each in anchors if each is not candidate]
            if distances_m and sign * min(distances_m) < best_signed_m:
                best, best_signed_m = candidate, sign * min(distances_m)
        return best is not None and best.matches(observation)

    def _reliable_landmarks(self, name: str) -> list[Landmark]:
        """Return the reliable landmarks of a name; if there are none, the confirmed ones."""
        confirmed = self._confirmed_landmarks(name)
        return [each for each in confirmed if self._evidence.is_reliable(each)] or confirmed

    def _confirmed_landmarks(self, name: str) -> list[Landmark]:
        """Return the confirmed landmarks of a name; if there are none, all of them."""
        landmarks = self._landmarks_of(name)
        return [each for each in landmarks if self._evidence.is_confirmed(each)] or landmarks

    def _landmarks_of(self, name: str) -> list[Landmark]:
        """Return the landmarks of a name's noun, without those of another colour."""
        return [each for each in self._object_map.with_phrase(noun_of(name)) if self._colours.allows(name, each)]
