"""Put a noun where its preposition and its verb say: target, anchor, or in a relation to what was named before."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from gausslite.domain.task import Predicate
from gausslite.task import lexicon
from gausslite.task.clause import Clause
from gausslite.task.draft import GraphDraft
from gausslite.task.phrases import NounPhrase, known_phrase
from gausslite.task.pieces import Piece, TokenKind
from gausslite.task.verbs import (
    DELIVERY_VERBS,
    FILLING_VERBS,
    GIVING_VERBS,
    GO_VERBS,
    INSPECTION_VERBS,
    LOOKING_VERBS,
    MOVING_VERBS,
    PLACE_VERBS,
    SEARCH_VERBS,
    STOPPING_VERBS,
)
from gausslite.task.words import words

_SOURCES: Final = {f"from_{place}": place for place in ("on", "under", "inside", "behind", "near")}
# after "on the table" these say where something goes, and others say where the table is
_FINAL_DESTINATIONS: Final = words("on inside")
_DESTINATIONS: Final = words("to on inside near under behind in_front_of above between left_of right_of")
# what is compared or swapped with something is a target as much as that is
_PAIRING: Final = words("compare swap exchange")
_PAST: Final = words("past beyond")


class NounPlacer:
    """Fills a draft with the nouns of one clause after another."""

    def __init__(self, draft: GraphDraft) -> None:
        self._draft = draft
        self.clause = Clause()

    def end_clause(self, verb: str | None) -> None:
        """Begin another clause. One whose only nouns are places ("look under the bed") means those places.

        In "in the kitchen, find the mug" the place belongs to the clause that follows.
        """
        before = self.clause
        if self._looks_for_what_was_lost():
            self._seek_there(before)
        elif not before.aside:
            self._mean_places()
        self.clause = Clause(verb=verb, referents=before.subjects or before.referents)
        self.clause.orphans, self.clause.mentioned = before.orphans, before.aside

    def _looks_for_what_was_lost(self) -> bool:
        clause = self.clause
        places_only = clause.verb in SEARCH_VERBS and bool(clause.orphans) and not clause.subjects
        return places_only and clause.mentioned and bool(clause.referents)

    def _seek_there(self, clause: Clause) -> None:
        """In "I lost my wallet, look under the bed" the wallet is sought there."""
        clause.subjects = list(clause.referents)
        self._draft.mean(clause.subjects)
        orphans, clause.orphans = clause.orphans, []
        for relation, noun in orphans:
            self.relate(relation, noun)

    def _mean_places(self) -> None:
        orphans, self.clause.orphans = self.clause.orphans, []
        for _, noun in orphans:
            self._draft.drop_anchor(noun.text)
            self.target(noun, joined=True)

    def place(self, noun: NounPhrase, pending: str | None, joined: bool, following: Sequence[Piece]) -> None:
        """Place one noun, knowing the preposition before it, whether it is joined, and the pieces that follow."""
        clause, after = self.clause, following[0] if following else None
        if pending == "of" and clause.skip_of:
            pending, joined = clause.handed_on, clause.handed_joined
            clause.skip_of, clause.handed_on = False, None
        if pending is None:
            if joined and clause.last_relation is not None and self._belongs_to_anchor(noun, after):
                self._locate_too(clause.last_relation, noun)
            elif self._is_receiver(following):
                self._draft.anchor(noun.text)
                clause.last_relation = "to"
            else:
                self.target(noun, joined and clause.last_relation is None)
            return
        self.by_preposition(pending, noun, following)

    def by_preposition(self, pending: str, noun: NounPhrase, following: Sequence[Piece] = ()) -> None:
        """What the noun is to the clause's objects, by the preposition before it."""
        clause = self.clause
        if pending == "closer":
            pending = "to" if clause.verb in DELIVERY_VERBS else "near"
        plainly = {"to": self._towards, "for": self._sought, "of": self._part_of, "via": self._on_the_way}
        if pending in plainly:
            plainly[pending](noun)
        elif pending == "when":
            return
        elif pending == "purpose":
            self._led_to(noun)
        elif pending == "inside" and noun.head in lexicon.CLOTHING and self._is_about_people():
            self.relate("near", noun)
        elif pending in _PAST and clause.verb in DELIVERY_VERBS:
            self._draft.anchor(noun.text)
        elif self._is_passed(pending) or (pending == "with" and clause.verb in _PAIRING):
            self.target(noun, joined=True)
        elif pending == "with" and clause.verb in FILLING_VERBS and clause.subjects:
            self._filled_with(noun)
        elif pending == "with":
            if noun.known and (clause.subjects or clause.verb is None):
                self._accompanied(noun)
        elif pending == "from" or pending in _SOURCES:
            self._taken_from(pending, noun)
        elif clause.last_relation in ("to", "with") or self._is_brought(pending, following):
            self._draft.anchor(noun.text)
            clause.last_relation = clause.last_relation if clause.last_relation == "with" else "to"
            clause.between = pending == "between"
        else:
            if clause.orphans and clause.verb in GO_VERBS | STOPPING_VERBS:
                self._mean_places()  # "stop behind the car near the tree"
            self.relate(pending, noun)

    def _on_the_way(self, noun: NounPhrase) -> None:
        self.target(noun)
        self.clause.route = True

    def _led_to(self, noun: NounPhrase) -> None:
        """A path that leads to a cabin makes it a goal; a door that does, or a key that opens it, does not."""
        if self.clause.route:
            self.target(noun)
        else:
            self.clause.last_relation = "with"

    def _is_about_people(self) -> bool:
        return any(subject.split()[-1] in lexicon.PEOPLE for subject in self.clause.subjects)

    def _is_brought(self, pending: str, following: Sequence[Piece]) -> bool:
        """In "take the chair and push it under the desk" and "put the mug on the desk" they are not there yet."""
        clause = self.clause
        if clause.by_reference and clause.verb in DELIVERY_VERBS and pending in _DESTINATIONS:
            return True
        return clause.verb in PLACE_VERBS and not clause.stated and self._is_last_place(pending, following)

    def _is_passed(self, pending: str) -> bool:
        return pending == "past" and self.clause.verb in GO_VERBS and bool(self.clause.subjects)

    def _locate_too(self, relation: str, noun: NounPhrase) -> None:
        if relation in ("to", "with"):
            self._draft.anchor(noun.text)
        else:
            self.relate(relation, noun)

    def _accompanied(self, noun: NounPhrase) -> None:
        """Who looks for a man with a hat is to see the hat; who wipes with a sponge is to have it."""
        if self.clause.last_relation == "to":
            self._draft.anchor(noun.text)
        elif self.clause.verb in LOOKING_VERBS or noun.head in lexicon.PARTS:
            self.relate("near", noun)
        else:
            self._draft.anchor(noun.text)
            self.clause.last_relation = "with"

    def _filled_with(self, noun: NounPhrase) -> None:
        """Who loads the van with boxes is to move the boxes."""
        places, self.clause.subjects = self.clause.subjects, []
        self._draft.targets = [target for target in self._draft.targets if target not in places]
        for place in places:
            self._draft.anchor(place)
        self.target(noun)

    def _is_receiver(self, following: Sequence[Piece]) -> bool:
        """In "hand the nurse the towel" the nurse locates where the towel goes."""
        clause = self.clause
        while len(following) > 1 and following[0].kind is TokenKind.PREPOSITION and following[1].kind is TokenKind.NOUN:
            following = following[2:]  # "bring the man in the wheelchair a drink"
        follows = bool(following) and following[0].kind is TokenKind.NOUN
        return follows and clause.verb in GIVING_VERBS and not clause.subjects

    def _is_last_place(self, pending: str, following: Sequence[Piece]) -> bool:
        """Of "on the table into the sink" only the sink is where it goes; "on the shelf in the garage" is one place."""
        more = [piece.word for piece in following[:1] if piece.kind is TokenKind.PREPOSITION]
        rooms = [piece.noun for piece in following[1:2] if piece.noun and piece.noun.head in lexicon.ROOMS]
        final = "to" in more or (pending == "on" and bool(_FINAL_DESTINATIONS.intersection(more)) and not rooms)
        return bool(self.clause.subjects) and pending in _DESTINATIONS and not final

    def _belongs_to_anchor(self, noun: NounPhrase, after: Piece | None) -> bool:
        """Near the sink and the stove: both locate. On the table and the keys: the keys are a target of their own."""
        if after is not None and after.kind is TokenKind.PREPOSITION and after.word not in ("of", "to", "for", "with"):
            return False
        if self.clause.last_relation == "between" or self.clause.between:
            return True
        return noun.head in lexicon.LANDMARKS and self.clause.last_relation not in ("on", "inside", "with")

    def target(self, noun: NounPhrase, joined: bool = False) -> None:
        """Make the noun a target: the clause is about it from here on, or about it too."""
        clause = self.clause
        self._draft.target(noun.text, aside=clause.aside)
        clause.subjects = [*clause.subjects, noun.text] if joined else [noun.text]
        clause.joined, clause.by_reference = joined, False
        clause.last_relation = None
        clause.superlative = noun.superlative or (joined and clause.superlative)
        clause.part = noun.head in lexicon.PARTS
        orphans, clause.orphans = clause.orphans, []
        for relation, anchor in orphans:
            self.relate(relation, anchor)

    def relate(self, relation: str, noun: NounPhrase) -> None:
        """Say where the clause's objects are; a place that is named before them waits for them."""
        clause = self.clause
        clause.last_relation = relation
        if not clause.subjects:
            clause.orphans.append((relation, noun))
            return
        self._draft.relate(relation, clause.subjects, noun.text)

    def _towards(self, noun: NounPhrase) -> None:
        clause = self.clause
        if clause.verb in GO_VERBS | STOPPING_VERBS:
            self._mean_places()  # "between the shelves to the exit"
        if clause.superlative and clause.subjects:
            self.relate(Predicate.CLOSEST_TO, noun)
        elif clause.route or not clause.subjects or clause.verb in GO_VERBS - MOVING_VERBS:
            self.target(noun, joined=bool(clause.subjects))
            clause.route = False
        else:
            self._draft.anchor(noun.text)
            clause.last_relation = "to"

    def _sought(self, noun: NounPhrase) -> None:
        """Searching the desk for keys seeks the keys near the desk; inspecting it for wear seeks no object."""
        clause = self.clause
        if clause.subjects and clause.verb in INSPECTION_VERBS and noun.head in lexicon.DEFECTS:
            return
        if clause.subjects and clause.verb in SEARCH_VERBS:
            places, clause.subjects = clause.subjects, []
            self._draft.targets = [target for target in self._draft.targets if target not in places]
            self.target(noun)
            for place in map(known_phrase, places):
                self.relate("inside" if place.head in lexicon.CONTAINERS | lexicon.ROOMS else "near", place)
        elif not clause.subjects:
            self.target(noun)

    def _part_of(self, noun: NounPhrase) -> None:
        clause = self.clause
        if clause.orphans:
            return
        if not clause.subjects:
            self.target(noun)
        elif (clause.part or noun.determined) and clause.last_relation is None:
            self.relate("near", noun)

    def _taken_from(self, pending: str, noun: NounPhrase) -> None:
        going = self.clause.verb in GO_VERBS - MOVING_VERBS and self.clause.subjects
        if going or self.clause.last_relation == "with":
            self._draft.anchor(noun.text)
        elif pending in _SOURCES:
            self.relate(_SOURCES[pending], noun)
        else:
            self.relate("inside" if noun.head in lexicon.CONTAINERS | lexicon.ROOMS else "on", noun)
