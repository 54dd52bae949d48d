"""The graph of a sentence while it is being read: targets, anchors, relations and what the operator should know."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from gausslite.domain.task import Predicate, Relation

_PREDICATES: Final = frozenset(predicate.value for predicate in Predicate)
# said as a distance the filter must not turn round
_NOT_NEAR: Final = frozenset({"far_from"})


class GraphDraft:
    """Grows with every noun; `settle` takes out what the sentence excludes and names what it only points at."""

    def __init__(self) -> None:
        self.targets: list[str] = []
        self.anchors: list[str] = []
        self.relations: list[Relation] = []
        self.warnings: list[str] = []
        self.excluded: list[str] = []
        self.whole_place: str | None = None
        self.unnamed: str | None = None
        self._statement_nouns: set[str] = set()

    def add_target(self, phrase: str, from_statement: bool = False) -> None:
        """An object of the task, or one that is only mentioned aside: it counts if the sentence asks for no other."""
        if phrase not in self.targets:
            self.targets.append(phrase)
            if from_statement:
                self._statement_nouns.add(phrase)
        if not from_statement:
            self._statement_nouns.discard(phrase)

    def confirm_targets(self, phrases: Sequence[str]) -> None:
        """What was mentioned aside is what "it" means later."""
        self._statement_nouns.difference_update(phrases)

    def add_anchor(self, phrase: str) -> None:
        """A noun that locates, listed once."""
        if phrase not in self.anchors:
            self.anchors.append(phrase)

    def drop_anchor(self, phrase: str) -> None:
        """Take an anchor out that no relation needs."""
        if phrase in self.anchors and not any(relation.anchor == phrase for relation in self.relations):
            self.anchors.remove(phrase)

    def add_relation(self, relation: str, targets: Sequence[str], anchor: str) -> None:
        """Put every target in this relation to the anchor; a relation that is no predicate is near, or dropped."""
        self.add_anchor(anchor)
        said = f"'{relation.replace('_', ' ')}' {anchor!r} is no relation that is known"
        if relation in _NOT_NEAR:
            self.warnings.append(f"{said}: it is dropped")
            return
        if relation not in _PREDICATES:
            self.warnings.append(f"{said}: read as near")
        predicate = Predicate(relation) if relation in _PREDICATES else Predicate.NEAR
        for target in targets:
            found = Relation(predicate, target, anchor)
            if found not in self.relations:
                self.relations.append(found)

    def finalise(self) -> None:
        """Take out what is to be left alone; where no target is named, a place or a "this" means every object."""
        if not self.targets and self.whole_place is not None:
            self.targets.append("object")
            self.warnings.append(f"{self.whole_place!r} is a place, not an object: every object in it is a target")
        if not self.targets and self.unnamed is not None:
            self.targets.append("object")
        if self.unnamed is not None and "object" in self.targets:
            self.warnings.append(f"{self.unnamed!r} points at something without a name: every object is a target")
        self._drop_statement_nouns()
        self.targets = [target for target in self.targets if target not in self.excluded]
        self.relations = [relation for relation in self.relations if relation.target in self.targets]
        self.warnings += [f"{phrase!r} is to be left alone and is no target" for phrase in self.excluded]

    def _drop_statement_nouns(self) -> None:
        """In "the baby sleeps, close the curtains" the baby is none of the task's business."""
        if not self._statement_nouns.issuperset(self.targets):
            self.targets = [target for target in self.targets if target not in self._statement_nouns]
            located = {relation.anchor for relation in self.relations if relation.target in self._statement_nouns}
            self.relations = [relation for relation in self.relations if relation.target in self.targets]
            located -= {relation.anchor for relation in self.relations}
            self.anchors = [anchor for anchor in self.anchors if anchor not in located]
