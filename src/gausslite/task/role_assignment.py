"""Put a noun where its preposition and its verb say: target, anchor, or in a relation to what was named before."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from gausslite.domain.task import Predicate
from gausslite.task import lexicon
from gausslite.task.chunk import Chunk, ChunkKind
from gausslite.task.clause import Clause
from gausslite.task.graph_draft import GraphDraft
from gausslite.task.noun_phrase import NounPhrase, phrase_from_text
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
from gausslite.task.word_set import word_set

_ORIGIN_RELATIONS: Final = {f"from_{place}": place for place in ("on", "under", "inside", "behind", "near")}
# after "on the table" these say where something goes, and others say where the table is
_FINAL_DESTINATIONS: Final = word_set("on inside")
_DESTINATION_RELATIONS: Final = word_set("to on inside near under behind in_front_of above between left_of right_of")
# what is compared or swapped with something is a target as much as that is
_PAIRING_VERBS: Final = word_set("compare swap exchange")
_PASSING_RELATIONS: Final = word_set("past beyond")


class RoleAssigner:
    """Fills a draft with the nouns of one clause after another."""

    def __init__(self, draft: GraphDraft) -> None:
        self._draft = draft
        self.clause = Clause()

    def end_clause(self, verb: str | None) -> None:
        """Begin another clause. One whose only nouns are places ("look under the bed") means those places.

        In "in the kitchen, find the mug" the place belongs to the clause that follows.
        """
        before = self.clause
        if self._searches_for_referent():
            self._search_there(before)
        elif not before.statement:
            self._make_places_targets()
        self.clause = Clause(verb=verb, referents=before.objects or before.referents)
        self.clause.pending_places, self.clause.follows_statement = before.pending_places, before.statement

    def _searches_for_referent(self) -> bool:
        clause = self.clause
        places_only = clause.verb in SEARCH_VERBS and bool(clause.pending_places) and not clause.objects
        return places_only and clause.follows_statement and bool(clause.referents)

    def _search_there(self, clause: Clause) -> None:
        """In "I lost my wallet, look under the bed" the wallet is sought there."""
        clause.objects = list(clause.referents)
        self._draft.confirm_targets(clause.objects)
        pending_places, clause.pending_places = clause.pending_places, []
        for relation, noun in pending_places:
            self.relate(relation, noun)

    def _make_places_targets(self) -> None:
        pending_places, self.clause.pending_places = self.clause.pending_places, []
        for _, noun in pending_places:
            self._draft.drop_anchor(noun.text)
            self.target(noun, joined=True)

    def assign(self, noun: NounPhrase, pending: str | None, joined: bool, following: Sequence[Chunk]) -> None:
        """Place one noun, knowing the preposition before it, whether it is joined, and the chunks that follow."""
        clause, after = self.clause, following[0] if following else None
        if pending == "of" and clause.skip_of_phrase:
            pending, joined = clause.inherited_preposition, clause.inherited_conjoined
            clause.skip_of_phrase, clause.inherited_preposition = False, None
        if pending is None:
            if joined and clause.last_relation is not None and self._is_second_anchor(noun, after):
                self._add_anchor(clause.last_relation, noun)
            elif self._is_recipient(following):
                self._draft.add_anchor(noun.text)
                clause.last_relation = "to"
            else:
                self.target(noun, joined and clause.last_relation is None)
            return
        self.assign_by_preposition(pending, noun, following)

    def assign_by_preposition(self, pending: str, noun: NounPhrase, following: Sequence[Chunk] = ()) -> None:
        """What the noun is to the clause's objects, by the preposition before it."""
        clause = self.clause
        if pending == "closer":
            pending = "to" if clause.verb in DELIVERY_VERBS else "near"
        plainly = {"to": self._destination, "for": self._search_object, "of": self._whole, "via": self._waypoint}
        if pending in plainly:
            plainly[pending](noun)
        elif pending == "when":
            return
        elif pending == "purpose":
            self._purpose_goal(noun)
        elif pending == "inside" and noun.head in lexicon.CLOTHING and self._acts_on_people():
            self.relate("near", noun)
        elif pending in _PASSING_RELATIONS and clause.verb in DELIVERY_VERBS:
            self._draft.add_anchor(noun.text)
        elif self._is_route_point(pending) or (pending == "with" and clause.verb in _PAIRING_VERBS):
            self.target(noun, joined=True)
        elif pending == "with" and clause.verb in FILLING_VERBS and clause.objects:
            self._load(noun)
        elif pending == "with":
            if noun.is_known and (clause.objects or clause.verb is None):
                self._companion(noun)
        elif pending == "from" or pending in _ORIGIN_RELATIONS:
            self._origin(pending, noun)
        elif clause.last_relation in ("to", "with") or self._is_destination(pending, following):
            self._draft.add_anchor(noun.text)
            clause.last_relation = clause.last_relation if clause.last_relation == "with" else "to"
            clause.between = pending == "between"
        else:
            if clause.pending_places and clause.verb in GO_VERBS | STOPPING_VERBS:
                self._make_places_targets()  # "stop behind the car near the tree"
            self.relate(pending, noun)

    def _waypoint(self, noun: NounPhrase) -> None:
        self.target(noun)
        self.clause.route = True

    def _purpose_goal(self, noun: NounPhrase) -> None:
        """A path that leads to a cabin makes it a goal; a door that does, or a key that opens it, does not."""
        if self.clause.route:
            self.target(noun)
        else:
            self.clause.last_relation = "with"

    def _acts_on_people(self) -> bool:
        return any(subject.split()[-1] in lexicon.PEOPLE for subject in self.clause.objects)

    def _is_destination(self, pending: str, following: Sequence[Chunk]) -> bool:
        """In "take the chair and push it under the desk" and "put the mug on the desk" they are not there yet."""
        clause = self.clause
        if clause.by_pronoun and clause.verb in DELIVERY_VERBS and pending in _DESTINATION_RELATIONS:
            return True
        return clause.verb in PLACE_VERBS and not clause.current_place and self._is_final_place(pending, following)

    def _is_route_point(self, pending: str) -> bool:
        return pending == "past" and self.clause.verb in GO_VERBS and bool(self.clause.objects)

    def _add_anchor(self, relation: str, noun: NounPhrase) -> None:
        if relation in ("to", "with"):
            self._draft.add_anchor(noun.text)
        else:
            self.relate(relation, noun)

    def _companion(self, noun: NounPhrase) -> None:
        """Who looks for a man with a hat is to see the hat; who wipes with a sponge is to have it."""
        if self.clause.last_relation == "to":
            self._draft.add_anchor(noun.text)
        elif self.clause.verb in LOOKING_VERBS or noun.head in lexicon.PARTS:
            self.relate("near", noun)
        else:
            self._draft.add_anchor(noun.text)
            self.clause.last_relation = "with"

    def _load(self, noun: NounPhrase) -> None:
        """Who loads the van with boxes is to move the boxes."""
        places, self.clause.objects = self.clause.objects, []
        self._draft.targets = [target for target in self._draft.targets if target not in places]
        for place in places:
            self._draft.add_anchor(place)
        self.target(noun)

    def _is_recipient(self, following: Sequence[Chunk]) -> bool:
        """In "hand the nurse the towel" the nurse locates where the towel goes."""
        clause = self.clause
        while len(following) > 1 and following[0].kind is ChunkKind.PREPOSITION and following[1].kind is ChunkKind.NOUN:
            following = following[2:]  # "bring the man in the wheelchair a drink"
        follows = bool(following) and following[0].kind is ChunkKind.NOUN
        return follows and clause.verb in GIVING_VERBS and not clause.objects

    def _is_final_place(self, pending: str, following: Sequence[Chunk]) -> bool:
        """Of "on the table into the sink" only the sink is where it goes; "on the shelf in the garage" is one place."""
        more = [chunk.word for chunk in following[:1] if chunk.kind is ChunkKind.PREPOSITION]
        rooms = [chunk.noun for chunk in following[1:2] if chunk.noun and chunk.noun.head in lexicon.ROOMS]
        final = "to" in more or (pending == "on" and bool(_FINAL_DESTINATIONS.intersection(more)) and not rooms)
        return bool(self.clause.objects) and pending in _DESTINATION_RELATIONS and not final

    def _is_second_anchor(self, noun: NounPhrase, after: Chunk | None) -> bool:
        """Near the sink and the stove: both locate. On the table and the keys: the keys are a target of their own."""
        if after is not None and after.kind is ChunkKind.PREPOSITION and after.word not in ("of", "to", "for", "with"):
            return False
        if self.clause.last_relation == "between" or self.clause.between:
            return True
        return noun.head in lexicon.COMMON_ANCHORS and self.clause.last_relation not in ("on", "inside", "with")

    def target(self, noun: NounPhrase, joined: bool = False) -> None:
        """Make the noun a target: the clause is about it from here on, or about it too."""
        clause = self.clause
        self._draft.add_target(noun.text, from_statement=clause.statement)
        clause.objects = [*clause.objects, noun.text] if joined else [noun.text]
        clause.conjoined, clause.by_pronoun = joined, False
        clause.last_relation = None
        clause.superlative = noun.superlative or (joined and clause.superlative)
        clause.is_part = noun.head in lexicon.PARTS
        pending_places, clause.pending_places = clause.pending_places, []
        for relation, anchor in pending_places:
            self.relate(relation, anchor)

    def relate(self, relation: str, noun: NounPhrase) -> None:
        """Say where the clause's objects are; a place that is named before them waits for them."""
        clause = self.clause
        clause.last_relation = relation
        if not clause.objects:
            clause.pending_places.append((relation, noun))
            return
        self._draft.add_relation(relation, clause.objects, noun.text)

    def _destination(self, noun: NounPhrase) -> None:
        clause = self.clause
        if clause.verb in GO_VERBS | STOPPING_VERBS:
            self._make_places_targets()  # "between the shelves to the exit"
        if clause.superlative and clause.objects:
            self.relate(Predicate.CLOSEST_TO, noun)
        elif clause.route or not clause.objects or clause.verb in GO_VERBS - MOVING_VERBS:
            self.target(noun, joined=bool(clause.objects))
            clause.route = False
        else:
            self._draft.add_anchor(noun.text)
            clause.last_relation = "to"

    def _search_object(self, noun: NounPhrase) -> None:
        """Searching the desk for keys seeks the keys near the desk; inspecting it for wear seeks no object."""
        clause = self.clause
        if clause.objects and clause.verb in INSPECTION_VERBS and noun.head in lexicon.DEFECTS:
            return
        if clause.objects and clause.verb in SEARCH_VERBS:
            places, clause.objects = clause.objects, []
            self._draft.targets = [target for target in self._draft.targets if target not in places]
            self.target(noun)
            for place in map(phrase_from_text, places):
                self.relate("inside" if place.head in lexicon.CONTAINERS | lexicon.ROOMS else "near", place)
        elif not clause.objects:
            self.target(noun)

    def _whole(self, noun: NounPhrase) -> None:
        clause = self.clause
        if clause.pending_places:
            return
        if not clause.objects:
            self.target(noun)
        elif (clause.is_part or noun.has_determiner) and clause.last_relation is None:
            self.relate("near", noun)

    def _origin(self, pending: str, noun: NounPhrase) -> None:
        going = self.clause.verb in GO_VERBS - MOVING_VERBS and self.clause.objects
        if going or self.clause.last_relation == "with":
            self._draft.add_anchor(noun.text)
        elif pending in _ORIGIN_RELATIONS:
            self.relate(_ORIGIN_RELATIONS[pending], noun)
        else:
            self.relate("inside" if noun.head in lexicon.CONTAINERS | lexicon.ROOMS else "on", noun)
