"""The graph of a sentence under construction: targets, anchors, relations and warnings for the operator."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from gausslite.domain.task import Predicate, Relation

_PREDICATES: Final = frozenset(predicate.value for predicate in Predicate)
# treating "far from" as near would reverse its meaning
_NOT_NEAR: Final = frozenset({"far_from"})


class GraphDraft:
    """A mutable task graph; `finalise` removes excluded objects and resolves targets without a name.

    excluded: objects that the sentence says to leave alone. whole_place: a place named instead of an object.
    unnamed: a demonstrative ("this") without a noun.
    """

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
        """Add an object of the task. One from a statement counts only if no request names a target."""
        if phrase not in self.targets:
            self.targets.append(phrase)
            if from_statement:
                self._statement_nouns.add(phrase)
        if not from_statement:
            self._statement_nouns.discard(phrase)

    def confirm_targets(self, phrases: Sequence[str]) -> None:
        """Make objects of a statement full targets, because a later "it" refers to them."""
        self._statement_nouns.difference_update(phrases)

    def add_anchor(self, phrase: str) -> None:
        """Add an anchor, once."""
        if phrase not in self.anchors:
            self.anchors.append(phrase)

    def drop_anchor(self, phrase: str) -> None:
        """Remove an anchor that no relation uses."""
        if phrase in self.anchors and not any(relation.anchor == phrase for relation in self.relations):
            self.anchors.remove(phrase)

    def add_relation(self, relation: str, targets: Sequence[str], anchor: str) -> None:
        """Relate every target to the anchor; a relation without a predicate becomes near, or is dropped."""
        self.add_anchor(anchor)
        unknown = f"'{relation.replace('_', ' ')}' {anchor!r} is not a known relation"
        if relation in _NOT_NEAR:
            self.warnings.append(f"{unknown}: it is dropped")
            return
        if relation not in _PREDICATES:
            self.warnings.append(f"{unknown}: treated as near")
        predicate = Predicate(relation) if relation in _PREDICATES else Predicate.NEAR
        for target in targets:
            new = Relation(predicate, target, anchor)
            if new not in self.relations:
                self.relations.append(new)

    def finalise(self) -> None:
        """Remove excluded objects; without a named target, a place or a "this" stands for every object."""
        if not self.targets and self.whole_place is not None:
            self.targets.append("object")
            self.warnings.append(f"{self.whole_place!r} is a place, not an object: every object in it is a target")
        if not self.targets and self.unnamed is not None:
            self.targets.append("object")
        if self.unnamed is not None and "object" in self.targets:
            self.warnings.append(f"{self.unnamed!r} refers to no named object: every object is a target")
        self._drop_statement_nouns()
        self.targets = [target for target in self.targets if target not in self.excluded]
        self.relations = [relation for relation in self.relations if relation.target in self.targets]
        self.warnings += [f"{phrase!r} is to be left alone and is not a target" for phrase in self.excluded]

    def _drop_statement_nouns(self) -> None:
        """Remove nouns of statements: the baby in "the baby sleeps, close the curtains"."""
        if not self._statement_nouns.issuperset(self.targets):
            self.targets = [target for target in self.targets if target not in self._statement_nouns]
            unused = {relation.anchor for relation in self.relations if relation.target in self._statement_nouns}
            self.relations = [relation for relation in self.relations if relation.target in self.targets]
            unused -= {relation.anchor for relation in self.relations}
            self.anchors = [anchor for anchor in self.anchors if anchor not in unused]
