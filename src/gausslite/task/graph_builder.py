"""Decide what each noun of a sentence is to the task: target, anchor, or none of its business."""

from __future__ import annotations

from typing import Final

from gausslite.domain.task import Predicate, Relation
from gausslite.task import lexicon
from gausslite.task.phrases import NounPhrase, adjectives_only
from gausslite.task.reading import Kind, Piece

_SUPPORTED: Final = frozenset(predicate.value for predicate in Predicate)
# said as a distance the filter must not turn round
_NEVER_NEAR: Final = frozenset({"far_from"})
_SOURCES: Final = {"from_under": "under", "from_inside": "inside", "from_behind": "behind", "from_near": "near"}
_DESTINATIONS: Final = frozenset({"to", "on", "inside", "near", "under", "behind", "in_front_of", "above", "between"})


class GraphBuilder:
    """Takes the pieces of one sentence in order; the lists hold the graph once `finish` was called."""

    def __init__(self) -> None:
        self.targets: list[str] = []
        self.anchors: list[str] = []
        self.relations: list[Relation] = []
        self.warnings: list[str] = []
        self.excluded: list[str] = []
        self._clause = _Clause()
        self._pending: str | None = None
        self._negated = False
        self._adjectives: list[NounPhrase] = []
        self._whole_place: str | None = None

    def add(self, before: Piece | None, piece: Piece, after: Piece | None) -> None:
        """Read one piece between its neighbours."""
        if piece.kind is Kind.VERB:
            self._verb(before, piece)
        elif piece.kind is Kind.NOUN and piece.noun is not None:
            self._noun(before, piece.noun, after)
        elif piece.kind is Kind.PREPOSITION:
            self._pending = piece.word
        elif piece.kind is Kind.NEGATION:
            self._pending, self._negated = None, True
            self._clause.nouns_since_negation = 0
            self._clause.verb_since_negation = False
        elif piece.kind is Kind.BREAK:
            self._new_clause(None)
            self._negated = False
        elif piece.kind is Kind.BACK_REFERENCE:
            self._back_reference()

    def finish(self) -> None:
        """Close the last clause and take out what the sentence says to leave alone."""
        self._new_clause(None)
        if not self.targets and self._whole_place is not None:
            self.targets.append("object")
            self.warnings.append(f"{self._whole_place!r} is a place, not an object: every object in it is a target")
        self.targets = [target for target in self.targets if target not in self.excluded]
        self.relations = [relation for relation in self.relations if relation.target in self.targets]
        self.warnings += [f"{phrase!r} is to be left alone and is no target" for phrase in self.excluded]

    def _verb(self, before: Piece | None, piece: Piece) -> None:
        same_negation = self._negated and (
            self._clause.nouns_since_negation == 0
            or piece.gerund
            or (before is not None and before.kind is Kind.JOIN and before.word == "or")
        )
        if not same_negation:
            self._negated = False
        self._pending = None
        self._clause.verb_since_negation = True
        if not same_negation and (self._clause.subjects or self._clause.orphans):
            self._new_clause(piece.word)
        else:
            self._clause.verb = piece.word

    def _new_clause(self, verb: str | None) -> None:
        """A clause whose only nouns are places ("look under the bed") means those places."""
        orphans, self._clause.orphans = self._clause.orphans, []
        for _, noun in orphans:
            self._drop_anchor(noun.text)
            self._target(noun)
        self._clause = _Clause(verb=verb, referents=self._clause.subjects or self._clause.referents)
        self._pending = None

    def _back_reference(self) -> None:
        if self._pending is None and self._clause.referents and not self._clause.subjects and not self._negated:
            self._clause.subjects = list(self._clause.referents)

    def _noun(self, before: Piece | None, noun: NounPhrase, after: Piece | None) -> None:
        joined = before is not None and before.kind is Kind.JOIN
        pending, self._pending = self._pending, None
        if adjectives_only(noun.words):
            if after is not None and after.kind is Kind.JOIN:
                self._adjectives.append(noun)
            return
        if not _names_object(noun, pending, after):
            self._dropped(noun, pending, after)
            return
        nouns = [*(_described(adjective, noun) for adjective in self._adjectives), noun]
        self._adjectives = []
        for each in nouns:
            if self._negated:
                self._exclude(each, pending)
            else:
                self._place(each, pending, joined, after)

    def _dropped(self, noun: NounPhrase, pending: str | None, after: Piece | None) -> None:
        """The edge of the table hands its preposition on to the table; a path to the door makes the door a goal."""
        if noun.head in lexicon.ROUTES:
            self._clause.route = True
        elif noun.head in lexicon.PLACES and pending is None:
            self._whole_place = noun.text
        leads_on = after is not None and after.kind is Kind.PREPOSITION and after.word == "of"
        self._clause.handed_on = pending if leads_on else None
        self._clause.skip_of = leads_on

    def _exclude(self, noun: NounPhrase, pending: str | None) -> None:
        clause = self._clause
        direct = pending is None or (clause.nouns_since_negation == 0 and clause.verb_since_negation)
        if not direct and clause.nouns_since_negation == 0:
            self.warnings.append(f"an exception by place ({noun.text!r}) is not supported: it is dropped")
        clause.nouns_since_negation += 1
        if direct and noun.text not in self.excluded:
            self.excluded.append(noun.text)

    def _place(self, noun: NounPhrase, pending: str | None, joined: bool, after: Piece | None) -> None:
        clause = self._clause
        if pending == "of" and clause.skip_of:
            pending = clause.handed_on
            clause.skip_of, clause.handed_on = False, None
        if pending is None:
            if joined and clause.last_relation is not None and self._belongs_to_anchor(noun, after):
                self._relate(clause.last_relation, noun)
            else:
                self._target(noun, joined and clause.last_relation is None)
            return
        self._by_preposition(pending, noun, after)

    def _by_preposition(self, pending: str, noun: NounPhrase, after: Piece | None) -> None:
        clause = self._clause
        if pending == "to":
            self._towards(noun)
        elif pending == "for":
            self._sought(noun)
        elif pending == "of":
            self._part_of(noun)
        elif pending == "with":
            if noun.known and clause.subjects:
                self._anchor(noun.text)
                clause.last_relation = "with"
        elif pending == "from" or pending in _SOURCES:
            self._taken_from(pending, noun)
        elif clause.last_relation == "to" or (
            clause.verb in lexicon.PLACE_VERBS and self._is_last_place(pending, after)
        ):
            self._anchor(noun.text)
            clause.last_relation = "to"
        else:
            self._relate(pending, noun)

    def _is_last_place(self, pending: str, after: Piece | None) -> bool:
        """In "put the mug on the table into the sink" only the sink is where the mug goes."""
        more = after is not None and after.kind is Kind.PREPOSITION and after.word in _DESTINATIONS
        return bool(self._clause.subjects) and pending in _DESTINATIONS and not more

    def _belongs_to_anchor(self, noun: NounPhrase, after: Piece | None) -> bool:
        """Near the sink and the stove: both locate. On the table and the keys: the keys are a target of their own."""
        if after is not None and after.kind is Kind.PREPOSITION and after.word not in ("of", "to", "for", "with"):
            return False
        if self._clause.last_relation == "between":
            return True
        return noun.head in lexicon.LANDMARKS and self._clause.last_relation not in ("on", "inside", "with")

    def _target(self, noun: NounPhrase, joined: bool = False) -> None:
        clause = self._clause
        if noun.text not in self.targets:
            self.targets.append(noun.text)
        clause.subjects = [*clause.subjects, noun.text] if joined else [noun.text]
        clause.last_relation = None
        clause.superlative = noun.superlative or (joined and clause.superlative)
        clause.part = noun.head in lexicon.PARTS
        orphans, clause.orphans = clause.orphans, []
        for relation, anchor in orphans:
            self._relate(relation, anchor)

    def _anchor(self, phrase: str) -> None:
        if phrase not in self.anchors:
            self.anchors.append(phrase)

    def _drop_anchor(self, phrase: str) -> None:
        if phrase in self.anchors and not any(relation.anchor == phrase for relation in self.relations):
            self.anchors.remove(phrase)

    def _relate(self, relation: str, noun: NounPhrase) -> None:
        clause = self._clause
        if not clause.subjects:
            clause.orphans.append((relation, noun))
            return
        self._anchor(noun.text)
        clause.last_relation = relation
        if relation in _NEVER_NEAR:
            self.warnings.append(f"{_said(relation)} {noun.text!r} is no relation that is known: it is dropped")
            return
        if relation not in _SUPPORTED:
            self.warnings.append(f"{_said(relation)} {noun.text!r} is no relation that is known: read as near")
        predicate = Predicate(relation) if relation in _SUPPORTED else Predicate.NEAR
        for subject in clause.subjects:
            found = Relation(predicate, subject, noun.text)
            if found not in self.relations:
                self.relations.append(found)

    def _towards(self, noun: NounPhrase) -> None:
        clause = self._clause
        if clause.superlative and clause.subjects:
            self._relate(Predicate.CLOSEST_TO, noun)
        elif clause.route or not clause.subjects or clause.verb in lexicon.GO_VERBS - lexicon.MOVING_VERBS:
            self._target(noun, joined=bool(clause.subjects))
            clause.route = False
        else:
            self._anchor(noun.text)
            clause.last_relation = "to"

    def _sought(self, noun: NounPhrase) -> None:
        """Searching the desk for keys seeks the keys and only looks at the desk."""
        clause = self._clause
        if clause.subjects and clause.verb in lexicon.SEARCH_VERBS:
            places, clause.subjects = clause.subjects, []
            self.targets = [target for target in self.targets if target not in places]
            self._target(noun)
            for place in places:
                self._relate("near", NounPhrase(tuple(place.split()), True, False))
        elif not clause.subjects:
            self._target(noun)

    def _part_of(self, noun: NounPhrase) -> None:
        clause = self._clause
        if not clause.subjects:
            self._target(noun)
        elif clause.part and clause.last_relation is None:
            self._relate("near", noun)

    def _taken_from(self, pending: str, noun: NounPhrase) -> None:
        if self._clause.verb in lexicon.GO_VERBS and self._clause.subjects:
            self._anchor(noun.text)
        elif pending in _SOURCES:
            self._relate(_SOURCES[pending], noun)
        else:
            self._relate("inside" if noun.head in lexicon.CONTAINERS | lexicon.ROOMS else "on", noun)


class _Clause:
    """What one verb has gathered so far."""

    def __init__(self, verb: str | None = None, referents: list[str] | None = None) -> None:
        self.verb = verb
        self.referents = referents or []
        self.subjects: list[str] = []
        self.orphans: list[tuple[str, NounPhrase]] = []
        self.last_relation: str | None = None
        self.superlative = False
        self.part = False
        self.route = False
        self.skip_of = False
        self.handed_on: str | None = None
        self.nouns_since_negation = 0
        self.verb_since_negation = False


def _names_object(noun: NounPhrase, pending: str | None, after: Piece | None) -> bool:
    """False for the robot itself, and for places, routes and measures that stand for something else."""
    if len(noun.words) == 1 and noun.head in lexicon.SELVES:
        return False
    if noun.head in lexicon.PLACES:
        return noun.head in lexicon.SOLID_PLACES and pending not in (None, "inside", "to")
    if noun.head in lexicon.ROUTES:
        return pending not in (None, "of", "for", "to")
    leads_on = after is not None and after.kind is Kind.PREPOSITION and after.word == "of"
    return noun.head not in lexicon.MEASURES or (noun.known and not leads_on)


def _described(adjective: NounPhrase, noun: NounPhrase) -> NounPhrase:
    """In "red and blue mugs", red takes the head that it shares."""
    return NounPhrase((*adjective.words, noun.head), adjective.determined, noun.superlative)


def _said(relation: str) -> str:
    return f"'{relation.replace('_', ' ')}'"
