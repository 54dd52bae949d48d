"""The graph of a sentence under construction: objects with roles, relations, and warnings for the operator."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

from gausslite.domain.task import Predicate, Relation, Superlative, TargetRole
from gausslite_language import lexicon
from gausslite_language.chunk import NounPhrase
from gausslite_language.lexicon import SUPERLATIVES
from gausslite_language.tokens import UNBOUNDED, Bounds

_PREDICATES: Final = frozenset(predicate.value for predicate in Predicate)


@dataclass(frozen=True, slots=True)
class RelationTerms:
    """How a preposition relates: its relation, whether it is negated, and its distance."""

    relation: str
    negated: bool = False
    bounds: Bounds = UNBOUNDED

    @property
    def keeps_away(self) -> bool:
        """Return True for "at least 2 m from", "not within 2 m of" and "out of reach of"."""
        low_m, high_m = self.bounds.min_m, self.bounds.max_m
        is_lower = (low_m is None) if self.negated else (high_m is None)
        return self.relation == "clear_of" or (self.bounds is not UNBOUNDED and self.relation == "near" and is_lower)


class GraphDraft:
    """A mutable task graph of noun phrases; `finalise` removes excluded objects and resolves targets without a name.

    excluded: objects that the sentence says to leave out. context: rooms and places. whole_place: a place named instead
    of an object. unnamed: a demonstrative ("this") without a noun. mentions: all phrases in their order.
    """

    def __init__(self) -> None:
        self.targets: list[str] = []
        self.roles: dict[str, TargetRole] = {}
        self.anchors: list[str] = []
        self.relations: list[Relation] = []
        self.warnings: list[str] = []
        self.excluded: list[str] = []
        self.context: list[str] = []
        self.mentions: list[str] = []
        self.whole_place: str | None = None
        self.unnamed: str | None = None
        self._statement_nouns: set[str] = set()

    def add_target(self, phrase: str, role: TargetRole = TargetRole.OBJECT, from_statement: bool = False) -> None:
        """Add an object of the task; its first role stands.

        An object of a statement counts only if no request names a target.
        """
        self.mentions.append(phrase)
        if phrase not in self.targets:
            self.targets.append(phrase)
            self.roles[phrase] = role
            if from_statement:
                self._statement_nouns.add(phrase)
        if not from_statement:
            if phrase in self._statement_nouns:
                self.roles[phrase] = role
            self._statement_nouns.discard(phrase)

    def remove_targets(self, phrases: Sequence[str]) -> None:
        """Remove objects that turn out to be places."""
        self.targets = [target for target in self.targets if target not in phrases]

    def exclude(self, phrase: str) -> None:
        """Add an excluded object, once."""
        self.mentions.append(phrase)
        if phrase not in self.excluded:
            self.excluded.append(phrase)

    def add_context(self, place: str) -> None:
        """Add a room or place, once."""
        if place not in self.context:
            self.context.append(place)

    def rename(self, phrase: str, new: str) -> None:
        """Replace a phrase everywhere, because its description has changed."""
        for phrases in (self.targets, self.anchors, self.mentions):
            phrases[:] = dict.fromkeys(new if known == phrase else known for known in phrases)
        if phrase in self.roles:
            self.roles.setdefault(new, self.roles.pop(phrase))
        if phrase in self._statement_nouns:
            self._statement_nouns.discard(phrase)
            self._statement_nouns.add(new)
        self.relations = [
            replace(
                relation,
                target=new if relation.target == phrase else relation.target,
                anchor=new if relation.anchor == phrase else relation.anchor,
            )
            for relation in self.relations
        ]

    def is_from_statement(self, phrase: str) -> bool:
        """Return True if only a statement has named this object so far."""
        return phrase in self._statement_nouns

    def confirm_targets(self, phrases: Sequence[str], role: TargetRole = TargetRole.OBJECT) -> None:
        """Make objects of a statement full targets, because a later "it" refers to them."""
        self.roles.update(dict.fromkeys(self._statement_nouns.intersection(phrases), role))
        self._statement_nouns.difference_update(phrases)

    def add_relation(self, terms: RelationTerms, targets: Sequence[str], anchor: str) -> None:
        """Relate every target to the anchor; a relation without a predicate becomes near, with a warning."""
        targets = [target for target in targets if target != anchor]  # "the box next to the other box"
        self.mentions.append(anchor)
        known = self._as_predicate(terms, anchor)
        if known is None:
            return
        if anchor not in self.anchors:
            self.anchors.append(anchor)
        predicate, negated = known
        for target in targets:
            new = Relation(predicate, target, anchor, negated, terms.bounds.min_m, terms.bounds.max_m)
            if new not in self.relations:
                self.relations.append(new)

    def _as_predicate(self, terms: RelationTerms, anchor: str) -> tuple[Predicate, bool] | None:
        """Return the predicate, and whether it is negated; None if the preposition states no relation."""
        shown = f"'{terms.relation.replace('_', ' ')}' {anchor!r}"
        if terms.relation in ("far_from", "clear_of"):
            return Predicate.NEAR, not terms.negated
        if terms.relation == "outside" and anchor.split()[-1] not in lexicon.PASSAGES | {"window", "elevator", "lift"}:
            return Predicate.INSIDE, not terms.negated
        if terms.relation == "at_distance":
            self.warnings.append(f"the distance from {anchor!r} is vague or negative: it is dropped")
            return None
        if terms.relation in _PREDICATES:
            return Predicate(terms.relation), terms.negated
        if terms.negated:
            self.warnings.append(f"not {shown} is not a known relation: it is dropped")
            return None
        self.warnings.append(f"{shown} is not a known relation: treated as near")
        return Predicate.NEAR, False

    def finalise(self) -> None:
        """Remove excluded objects and unused anchors; without a target, a place or a "this" means every object."""
        if not self.targets and self.whole_place is not None:
            self.add_target("object")
            self.warnings.append(f"{self.whole_place!r} is a place, not an object: every object in it is a target")
        if not self.targets and self.unnamed is not None:
            self.add_target("object")
        if self.unnamed is not None and "object" in self.targets:
            self.warnings.append(f"{self.unnamed!r} refers to no named object: every object is a target")
        self._drop_statement_nouns()
        self.targets = [target for target in self.targets if target not in self.excluded]
        self.relations = [relation for relation in self.relations if relation.target in self.targets]
        used = {relation.anchor for relation in self.relations}
        self.anchors = [anchor for anchor in self.anchors if anchor in used]

    def _drop_statement_nouns(self) -> None:
        """Remove nouns of statements: the baby in "the baby sleeps, close the curtains"."""
        if not self._statement_nouns.issuperset(self.targets):
            self.targets = [target for target in self.targets if target not in self._statement_nouns]


class Clause:
    """The objects a verb acts on, the candidates for "it" (referents), and places still without an object.

    places: the destinations or tools named last, which further places describe. terms: of the latest preposition.
    superlative: "nearest" or "farthest" before the latest object. conjoined, is_alternative: a conjunction, or "or",
    precedes the latest noun. describes: an indefinite noun after "with" does. crosses: the way crosses a place.
    by_pronoun: the objects come from "it".
    adds_place: the preposition follows a conjunction. route: the clause mentions a path. skip_of_phrase: the next "of"
    continues a noun that names no object. inherits_goal: the place that follows says where the goal is.
    """

    def __init__(self, verb: str | None = None, referents: list[str] | None = None) -> None:
        self.verb = verb
        self.referents = referents or []
        self.objects: list[str] = []
        self.pending_places: list[tuple[RelationTerms, NounPhrase]] = []
        self.last_relation: str | None = None
        self.terms = RelationTerms("near")
        self.places: list[str] = []
        self.superlative: str | None = None
        self.statement = self.follows_statement = self.by_pronoun = self.conjoined = self.is_alternative = False
        self.describes = self.crosses = self.route = self.is_part = self.between = self.in_space = False
        self.adds_place = self.current_place = self.skip_of_phrase = self.inherited_conjoined = False
        self.inherits_goal = self.verb_since_negation = False
        self.preposition = ""
        self.inherited_preposition: str | None = None
        self.nouns_since_negation = 0


class RelationAssigner:
    """Add the relations of the current clause to a draft."""

    def __init__(self, draft: GraphDraft) -> None:
        self._draft = draft
        self.clause = Clause()

    def relate(self, relation: str, noun: NounPhrase) -> None:
        """Relate the clause's objects to the noun; a place named before any object is kept for the next object."""
        self.relate_by(RelationTerms(relation, self.clause.terms.negated, self.clause.terms.bounds), noun)

    def relate_by(self, terms: RelationTerms, noun: NounPhrase) -> None:
        """Relate the clause's objects by complete terms, as `relate` does."""
        clause = self.clause
        clause.last_relation = terms.relation
        clause.in_space = self._is_context(terms, noun)
        if not clause.objects:
            clause.pending_places.append((terms, noun))
        elif clause.in_space:
            self._draft.add_context(noun.text)
        else:
            self._draft.add_relation(terms, clause.objects, noun.text)

    def relate_places(self, terms: RelationTerms, noun: NounPhrase) -> None:
        """Relate the destinations or tools named last: "put it on the table by the window"."""
        if self._is_context(terms, noun):
            self._draft.add_context(noun.text)
        else:
            self._draft.add_relation(terms, self.clause.places, noun.text)

    def _is_context(self, terms: RelationTerms, noun: NounPhrase) -> bool:
        is_context = terms.relation == "inside" and lexicon.is_space(noun.words)
        if is_context and terms.negated:
            self._draft.warnings.append(f"not in {noun.text!r}: a place is not evaluated, the exception is dropped")
        return is_context

    def is_extreme(self, pending: str) -> bool:
        """Return True for "the nearest chair to", "the farthest cone from"."""
        superlative = SUPERLATIVES.get(self.clause.superlative or "")
        is_farthest = superlative is Superlative.FARTHEST and pending == "from"
        return bool(self.clause.objects) and (is_farthest or (superlative is not None and pending == "to"))

    def relate_extreme(self, noun: NounPhrase) -> None:
        """Relate the clause's objects as the nearest or farthest to the noun."""
        clause = self.clause
        word = clause.superlative or ""
        for phrase in list(clause.objects):
            self.rename(phrase, " ".join(part for part in phrase.split() if part != word))
        farthest = SUPERLATIVES[word] is Superlative.FARTHEST
        clause.superlative = None
        self.relate(Predicate.FARTHEST_FROM if farthest else Predicate.CLOSEST_TO, noun)

    def rename(self, phrase: str, new: str) -> None:
        """Change the description of an object that the sentence has named."""
        self._draft.rename(phrase, new)
        for phrases in (self.clause.objects, self.clause.referents, self.clause.places):
            phrases[:] = [new if known == phrase else known for known in phrases]
