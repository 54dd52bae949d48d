"""Decide what each noun of a sentence is to the task: target, anchor, or none of its business."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from gausslite.domain.task import Predicate
from gausslite.task import lexicon
from gausslite.task.clause import Clause, described, names_object
from gausslite.task.draft import GraphDraft
from gausslite.task.phrases import NounPhrase, adjectives_only, known_phrase
from gausslite.task.reading import Kind, Piece
from gausslite.task.words import words

_SOURCES: Final = {f"from_{place}": place for place in ("on", "under", "inside", "behind", "near")}
# after "on the table" these say where something goes, and others say where the table is
_FINAL_DESTINATIONS: Final = words("on inside")
_DESTINATIONS: Final = words("to on inside near under behind in_front_of above between left_of right_of")
_LOOKING_VERBS: Final = (
    lexicon.SEARCH_VERBS
    | lexicon.GO_VERBS
    | words("find locate identify detect spot map reconstruct photograph count track avoid")
)


class GraphBuilder:
    """Takes the pieces of one sentence in order and hands out the draft of its graph."""

    def __init__(self) -> None:
        self._draft = GraphDraft()
        self._clause = Clause()
        self._pending: str | None = None
        self._negated = False
        self._adjectives: list[NounPhrase] = []
        self._following: Sequence[Piece] = ()

    def add(self, before: Piece | None, piece: Piece, following: Sequence[Piece]) -> None:
        """Read one piece, knowing the one before it and all that follow."""
        after, self._following = (following[0] if following else None), following
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
            self._back_reference(piece.word, before)
        elif piece.kind is Kind.POINTING:
            self._pointing(piece.word, before, after)

    def finish(self) -> GraphDraft:
        """Close the last clause; the draft without what the sentence says to leave alone."""
        self._new_clause(None)
        self._draft.settle()
        return self._draft

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
            self._draft.drop_anchor(noun.text)
            self._target(noun)
        self._clause = Clause(verb=verb, referents=self._clause.subjects or self._clause.referents)
        self._pending = None

    def _back_reference(self, word: str, before: Piece | None) -> None:
        """The words "it" and "them" are the clause's objects, or behind a preposition what was named before these."""
        clause = self._clause
        if not clause.referents and not clause.subjects and before is not None and before.kind is Kind.VERB:
            self._pointing(word, before, None)
            return
        pending, self._pending = self._pending, None
        if self._negated:
            return
        if pending is None:
            clause.subjects = clause.subjects or list(clause.referents)
            return
        named, subjects = (clause.subjects[:-1], clause.subjects[-1:]) if clause.joined else (
            clause.referents, clause.subjects
        )  # fmt: skip
        if named and subjects:
            clause.subjects = subjects
            for each in named:
                self._by_preposition(pending, known_phrase(each))

    def _pointing(self, word: str, before: Piece | None, after: Piece | None) -> None:
        """A "this" that points at something without naming it."""
        if self._negated or (self._clause.verb is None and self._pending is None):
            return
        self._draft.unnamed = self._draft.unnamed or word
        if self._pending is None:
            self._noun(before, known_phrase("object"), after)
        self._pending = None

    def _noun(self, before: Piece | None, noun: NounPhrase, after: Piece | None) -> None:
        joined = before is not None and before.kind is Kind.JOIN
        pending, self._pending = self._pending, None
        if adjectives_only(noun.words):
            if after is not None and after.kind is Kind.JOIN:
                self._adjectives.append(noun)
            return
        if not names_object(noun, pending, after):
            self._dropped(noun, pending, joined, after)
            return
        nouns = [*(described(adjective, noun) for adjective in self._adjectives), noun]
        self._adjectives = []
        for each in nouns:
            if self._negated:
                self._exclude(each, pending)
            else:
                self._place(each, pending, joined, after)

    def _dropped(self, noun: NounPhrase, pending: str | None, joined: bool, after: Piece | None) -> None:
        """The edge of the table hands its preposition on to the table; a path to the door makes the door a goal."""
        if noun.head in lexicon.ROUTES:
            self._clause.route = True
        elif noun.head in lexicon.PLACES and pending is None:
            self._draft.whole_place = noun.text
        leads_on = after is not None and after.kind is Kind.PREPOSITION and after.word == "of"
        self._clause.handed_on = pending if leads_on else None
        self._clause.skip_of, self._clause.handed_joined = leads_on, joined

    def _exclude(self, noun: NounPhrase, pending: str | None) -> None:
        clause = self._clause
        direct = pending is None or (clause.nouns_since_negation == 0 and clause.verb_since_negation)
        if not direct and clause.nouns_since_negation == 0:
            self._draft.warnings.append(f"an exception by place ({noun.text!r}) is not supported: it is dropped")
        clause.nouns_since_negation += 1
        if direct and noun.text not in self._draft.excluded:
            self._draft.excluded.append(noun.text)

    def _place(self, noun: NounPhrase, pending: str | None, joined: bool, after: Piece | None) -> None:
        clause = self._clause
        if pending == "of" and clause.skip_of:
            pending, joined = clause.handed_on, clause.handed_joined
            clause.skip_of, clause.handed_on = False, None
        if pending is None:
            if joined and clause.last_relation is not None and self._belongs_to_anchor(noun, after):
                self._relate(clause.last_relation, noun)
            elif self._is_receiver(after):
                self._draft.anchor(noun.text)
            else:
                self._target(noun, joined and clause.last_relation is None)
            return
        self._by_preposition(pending, noun)

    def _by_preposition(self, pending: str, noun: NounPhrase) -> None:
        clause = self._clause
        if pending == "to":
            self._towards(noun)
        elif pending == "for":
            self._sought(noun)
        elif pending == "of":
            self._part_of(noun)
        elif pending == "beyond" and clause.verb in lexicon.DELIVERY_VERBS:
            self._draft.anchor(noun.text)
        elif pending == "with":
            if noun.known and clause.subjects:
                self._accompanied(noun)
        elif pending == "from" or pending in _SOURCES:
            self._taken_from(pending, noun)
        elif clause.last_relation == "to" or (clause.verb in lexicon.PLACE_VERBS and self._is_last_place(pending)):
            self._draft.anchor(noun.text)
            clause.last_relation = "to"
        else:
            self._relate(pending, noun)

    def _accompanied(self, noun: NounPhrase) -> None:
        """Who looks for a man with a hat is to see the hat; who wipes with a sponge is to have it."""
        if self._clause.verb in _LOOKING_VERBS:
            self._relate("near", noun)
        else:
            self._draft.anchor(noun.text)
            self._clause.last_relation = "with"

    def _is_receiver(self, after: Piece | None) -> bool:
        """In "hand the nurse the towel" the nurse locates where the towel goes."""
        clause = self._clause
        follows = after is not None and after.kind is Kind.NOUN
        return follows and clause.verb in lexicon.GIVING_VERBS and not clause.subjects

    def _is_last_place(self, pending: str) -> bool:
        """Of "on the table into the sink" only the sink is where it goes; "on the shelf in the garage" is one place."""
        more = [piece.word for piece in self._following[:1] if piece.kind is Kind.PREPOSITION]
        rooms = [piece.noun for piece in self._following[1:2] if piece.noun and piece.noun.head in lexicon.ROOMS]
        final = "to" in more or (pending == "on" and bool(_FINAL_DESTINATIONS.intersection(more)) and not rooms)
        return bool(self._clause.subjects) and pending in _DESTINATIONS and not final

    def _belongs_to_anchor(self, noun: NounPhrase, after: Piece | None) -> bool:
        """Near the sink and the stove: both locate. On the table and the keys: the keys are a target of their own."""
        if after is not None and after.kind is Kind.PREPOSITION and after.word not in ("of", "to", "for", "with"):
            return False
        if self._clause.last_relation == "between":
            return True
        return noun.head in lexicon.LANDMARKS and self._clause.last_relation not in ("on", "inside", "with")

    def _target(self, noun: NounPhrase, joined: bool = False) -> None:
        clause = self._clause
        if noun.text not in self._draft.targets:
            self._draft.targets.append(noun.text)
        clause.subjects = [*clause.subjects, noun.text] if joined else [noun.text]
        clause.joined = joined
        clause.last_relation = None
        clause.superlative = noun.superlative or (joined and clause.superlative)
        clause.part = noun.head in lexicon.PARTS
        orphans, clause.orphans = clause.orphans, []
        for relation, anchor in orphans:
            self._relate(relation, anchor)

    def _relate(self, relation: str, noun: NounPhrase) -> None:
        clause = self._clause
        clause.last_relation = relation
        if not clause.subjects:
            clause.orphans.append((relation, noun))
            return
        self._draft.relate(relation, clause.subjects, noun.text)

    def _towards(self, noun: NounPhrase) -> None:
        clause = self._clause
        if clause.superlative and clause.subjects:
            self._relate(Predicate.CLOSEST_TO, noun)
        elif clause.route or not clause.subjects or clause.verb in lexicon.GO_VERBS - lexicon.MOVING_VERBS:
            self._target(noun, joined=bool(clause.subjects))
            clause.route = False
        else:
            self._draft.anchor(noun.text)
            clause.last_relation = "to"

    def _sought(self, noun: NounPhrase) -> None:
        """Searching the desk for keys seeks the keys near the desk; inspecting it for wear seeks no object."""
        clause = self._clause
        if clause.subjects and clause.verb in lexicon.INSPECTION_VERBS and not noun.known:
            return
        if clause.subjects and clause.verb in lexicon.SEARCH_VERBS:
            places, clause.subjects = clause.subjects, []
            self._draft.targets = [target for target in self._draft.targets if target not in places]
            self._target(noun)
            for place in places:
                self._relate("near", known_phrase(place))
        elif not clause.subjects:
            self._target(noun)

    def _part_of(self, noun: NounPhrase) -> None:
        clause = self._clause
        if not clause.subjects:
            self._target(noun)
        elif (clause.part or noun.determined) and clause.last_relation is None:
            self._relate("near", noun)

    def _taken_from(self, pending: str, noun: NounPhrase) -> None:
        if self._clause.verb in lexicon.GO_VERBS and self._clause.subjects:
            self._draft.anchor(noun.text)
        elif pending in _SOURCES:
            self._relate(_SOURCES[pending], noun)
        else:
            self._relate("inside" if noun.head in lexicon.CONTAINERS | lexicon.ROOMS else "on", noun)
