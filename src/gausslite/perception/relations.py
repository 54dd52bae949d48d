"""Evaluate the relations of a target on all objects seen so far (Sec. III-B.3)."""

from __future__ import annotations

from dataclasses import dataclass

from gausslite.domain.task import Predicate, Relation, TaskGraph, noun_of
from gausslite.perception.evidence import Evidence
from gausslite.perception.object_map import Landmark, ObjectMap, Observation
from gausslite.perception.selector import Fit, Selector, TaskObjects


@dataclass(frozen=True, slots=True, eq=False)
class NamedObjects:
    """The landmarks that the names of a task mean: of a name's noun, without those of another attribute."""

    object_map: ObjectMap
    evidence: Evidence
    selector: Selector

    def seen(self, name: str) -> list[Landmark]:
        """Return all landmarks of a name."""
        return [
            landmark
            for landmark in self.object_map.with_phrase(noun_of(name))
            if self.selector.fit(name, landmark.measured) is not Fit.NO
        ]

    def confirmed(self, name: str) -> list[Landmark]:
        """Return the confirmed landmarks of a name; if there are none, all of them."""
        seen = self.seen(name)
        confirmed = self.evidence.confirmed(self.object_map.objects)
        return [landmark for landmark in seen if any(landmark is other for other in confirmed)] or seen

    def candidates(self, name: str) -> list[Landmark]:
        """Return the confirmed landmarks without those of far lower scores: one false candidate decides."""
        return self.evidence.without_low_scores(self.confirmed(name))


class RelationFilter:
    """Decides whether an observed object satisfies the relations of a target, to objects in view or not."""

    def __init__(self, graph: TaskGraph, objects: TaskObjects, selector: Selector) -> None:
        """Objects and selector are shared with their owner, which observes frames."""
        self._conditions = {target: conditions_of(graph, target) for target in graph.targets}
        self._objects = objects
        self._selector = selector

    @property
    def unseen_anchors(self) -> tuple[str, ...]:
        """Names of anchors that no frame has shown yet."""
        conditions = [condition for of_target in self._conditions.values() for condition in of_target]
        relations = [relation for condition in conditions for relation in condition]
        needed = dict.fromkeys(relation.anchor for relation in relations if not self._selector.decides(relation))
        return tuple(name for name in needed if not self._objects.seen(name))

    def satisfies(self, target: str, observation: Observation) -> bool:
        """Return True if no negated relation holds, and any other does (Sec. III-B.3) or none can be evaluated.

        Relations to anchors that were never seen with their attributes are not evaluated. Of negated relations that
        attributes decide, those that are not sure count too.
        """
        results = []
        for relations in self._conditions[target]:
            holds = self._selector.holds(relations, observation, self._objects)
            if not relations[0].negated:
                results.append(holds)
            elif holds or (holds is None and self._selector.decides(relations[0])):
                return False
        evaluated = [holds for holds in results if holds is not None]
        return not evaluated or any(evaluated)


def conditions_of(graph: TaskGraph, target: str) -> list[tuple[Relation, ...]]:
    """Return the relations of a target, one each; all the anchors of `between` form one condition."""
    conditions: dict[object, tuple[Relation, ...]] = {}
    for number, relation in enumerate(graph.relations):
        if relation.target == target:
            key = relation.negated if relation.predicate is Predicate.BETWEEN else f"relation {number}"
            conditions[key] = (*conditions.get(key, ()), relation)
    return list(conditions.values())
