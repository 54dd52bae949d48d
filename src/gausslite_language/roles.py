"""Assign each noun of a clause its role, or the relation by which it locates another noun."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

from gausslite.domain.task import TargetRole
from gausslite_language import lexicon, verbs
from gausslite_language.chunk import Chunk, ChunkKind, NounPhrase, phrase_from_text
from gausslite_language.graph_draft import Clause, GraphDraft, RelationAssigner, RelationTerms
from gausslite_language.lexicon import word_set
from gausslite_language.nouns import is_thing

_ORIGIN_RELATIONS: Final = {f"from_{place}": place for place in ("on", "under", "inside", "behind", "near")}
# after "on the table" these state the destination; other prepositions locate the table
_FINAL_DESTINATIONS: Final = word_set("on inside")
_DESTINATION_RELATIONS: Final = word_set(
    "to on inside near under behind in_front_of above between left_of right_of past"
)
# both objects of these verbs are targets
_PAIRING_VERBS: Final = word_set("compare swap exchange")
_PUSHED_TO: Final = word_set("near under behind in_front_of between left_of right_of")
_SHIFTING_VERBS: Final = (verbs.CARRY_VERBS | verbs.MOVING_VERBS) - verbs.FETCHING_VERBS | {"carry"}
_ROUTE_PREPOSITIONS: Final = word_set("around past through along across")
_CROSSING_VERBS: Final = verbs.LEAVING_VERBS | (verbs.GO_VERBS - verbs.REACHING_VERBS - verbs.COVERING_VERBS)
_PASSING_VERBS: Final = verbs.GO_VERBS - verbs.STOPPING_VERBS - word_set("park dock land")
_GOING_ON: Final = verbs.TRAVEL_VERBS | {"keep", "turn", "pass"}


class RoleAssigner:
    """Add the nouns of each clause to a draft."""

    def __init__(self, draft: GraphDraft) -> None:
        self._draft = draft
        self._relations = RelationAssigner(draft)
        self.rename = self._relations.rename

    @property
    def clause(self) -> Clause:
        """The current clause."""
        return self._relations.clause

    def end_clause(self, verb: str | None, next_verb: str | None) -> None:
        """Start another clause. The places of a clause without objects ("look under the bed") become targets.

        In "in the kitchen, find the mug" the place belongs to the following clause.
        """
        before = self.clause
        if self._searches_for_referent():
            self._search_places_for_referents(before)
        elif not before.statement:  # "walk between the columns and stop at the altar"
            self._make_places_targets(passes=before.verb in _PASSING_VERBS and next_verb in _GOING_ON)
        self._relations.clause = Clause(verb=verb, referents=before.objects or before.referents)
        self.clause.pending_places, self.clause.follows_statement = before.pending_places, before.statement

    def _searches_for_referent(self) -> bool:
        clause = self.clause
        places_only = clause.verb in verbs.SEARCH_VERBS and bool(clause.pending_places) and not clause.objects
        # "there is a cabinet. placed under the table"
        describes = clause.verb is None and bool(clause.pending_places) and not clause.objects and clause.statement
        return (places_only or describes) and clause.follows_statement and bool(clause.referents)

    def _search_places_for_referents(self, clause: Clause) -> None:
        """Search the places for the referents, as in "I lost my wallet, look under the bed"."""
        clause.objects = list(clause.referents)
        self._draft.confirm_targets(clause.objects)
        pending_places, clause.pending_places = clause.pending_places, []
        for terms, noun in pending_places:
            self._relations.relate_by(terms, noun)

    def reach_places(self) -> None:
        """Make the places of "wait by the door" destinations."""
        if self.clause.verb is not None:
            self._make_places_targets()

    def leave_context(self) -> None:
        """Make rooms and places before the verb context: "on the second floor, go to the office"."""
        places, self.clause.pending_places = self.clause.pending_places, []
        for terms, noun in places:
            if terms.relation == "inside" and lexicon.is_space(noun.words):
                self._draft.add_context(noun.text)
            else:
                self.clause.pending_places.append((terms, noun))

    def _make_places_targets(self, passes: bool = False) -> None:
        pending_places, self.clause.pending_places = self.clause.pending_places, []
        going = self.clause.verb in verbs.TRAVEL_VERBS
        for terms, noun in pending_places:
            if self.clause.verb == "turn" and lexicon.is_space(noun.words):
                self._draft.add_context(noun.text)  # "turn right at the end of the hallway"
                continue
            passed = (passes and terms.relation in ("between", "past", "under")) or terms.relation == "with"
            self.target(noun, TargetRole.DESTINATION if going and not passed else TargetRole.OBJECT, conjoined=True)

    def assign(self, noun: NounPhrase, pending: str | None, conjoined: bool, following: Sequence[Chunk]) -> None:
        """Assign one noun, given its preposition, whether a conjunction precedes it, and the following chunks."""
        clause = self.clause
        if pending == "of" and clause.skip_of_phrase:
            pending, conjoined = clause.inherited_preposition, clause.inherited_conjoined
            clause.skip_of_phrase, clause.inherited_preposition = False, None
        if pending is None:
            if lexicon.is_space(noun.words) and clause.verb in _CROSSING_VERBS | {"take"} and not clause.objects:
                self._draft.add_context(noun.text)
                clause.crosses, clause.verb = True, "cross"  # "leave the kitchen through the door"
            elif conjoined and clause.last_relation is not None and self._is_second_anchor(noun):
                self._add_anchor(clause.last_relation, noun)
            elif self._is_recipient(following):
                self._add_destination(noun)
            else:
                self.target(noun, self.role_of_object(noun.head), conjoined and clause.last_relation is None)
            return
        self.assign_by_preposition(pending, noun, following)
        clause.describes = clause.preposition in ("with", "near", "has", "without") and not noun.is_definite

    def assign_by_preposition(self, pending: str, noun: NounPhrase, following: Sequence[Chunk] = ()) -> None:
        """Assign the noun's role relative to the clause's objects, by the preposition before it."""
        clause = self.clause
        if self._relations.is_extreme(pending):
            self._relations.relate_extreme(noun)
            return
        if clause.verb in verbs.PLACE_VERBS and not (clause.objects or clause.pending_places) and clause.referents:
            clause.objects, clause.by_pronoun = list(clause.referents), True  # "rinse the cup and place on the rack"
        if pending == "closer":
            moving = verbs.DELIVERY_VERBS - verbs.FETCHING_VERBS | verbs.GO_VERBS
            pending = "to" if clause.verb in moving and not clause.current_place else "closest_to"
        handlers = {
            "to": self._destination,
            "for": self._assign_searched_object,
            "of": self._assign_after_of,
            "via": self._assign_waypoint,
        }
        if pending in handlers:
            handlers[pending](noun)
        elif pending == "when":
            if clause.verb in verbs.GO_VERBS | {"turn"} and noun.has_determiner and is_thing(noun.head):
                self._assign_waypoint(noun)  # "turn right after the painting"
        elif pending == "purpose" and self._acts_on_people():
            self._relations.relate("near", noun)  # "the man talking to the nurse"
        elif pending == "purpose":
            clause.last_relation = "with"  # where a door leads or what a key opens
        elif pending == "inside" and noun.head in lexicon.CLOTHING and self._acts_on_people():
            self._relations.relate("near", noun)
        elif self._assign_on_route(pending, noun):
            return
        elif pending == "with" and clause.terms.negated and (clause.places or clause.verb in verbs.TOOL_VERBS):
            self._draft.exclude(noun.text)  # "with the sponge, not with the towel"
        elif pending == "with":
            self._assign_with(noun)
        elif pending == "from" or pending in _ORIGIN_RELATIONS:
            self._assign_origin(pending, noun)
        else:
            self._assign_place(pending, noun, following)

    def _assign_on_route(self, pending: str, noun: NounPhrase) -> bool:
        """Make a noun that the way passes a target; return False for other nouns."""
        clause = self.clause
        by_route, aimless = clause.preposition in _ROUTE_PREPOSITIONS, not (clause.objects or clause.pending_places)
        moves_by = (by_route or clause.preposition == "by") and clause.verb in _PASSING_VERBS
        if (
            (moves_by and (clause.adds_place or aimless))  # "walk by the bathroom, by the bedroom"
            or (pending == "past" and clause.verb in verbs.TRAVEL_VERBS)
            or (pending == "with" and clause.verb in _PAIRING_VERBS)
        ):
            self._assign_waypoint(noun, conjoined=True)
        else:
            return False
        return True

    def _assign_with(self, noun: NounPhrase) -> None:
        """Assign a noun after "with": contents, a tool, or what describes an object or a place."""
        clause = self.clause
        if clause.verb in verbs.FILLING_VERBS and clause.objects:
            self._assign_loaded(noun)
            return
        if clause.inherits_goal and noun.is_definite:
            clause.inherits_goal = False
            self._destination(noun)  # "to the area with the cones"
            return
        if self._describes_room(noun):
            return  # "in the bathroom with two sinks"
        if clause.verb in verbs.TRAVEL_VERBS:
            self.reach_places()  # "stop at the shelf with the boxes"
            if not clause.objects and noun.is_definite and not clause.in_space:
                self._assign_waypoint(noun)  # "walk on with the railing on your left"
                return
        if not clause.objects and clause.verb is None and not clause.terms.negated:
            clause.pending_places.append((clause.terms, noun))  # "with a sponge, wipe the table"
        elif (noun.is_known or noun.has_determiner) and (clause.objects or clause.verb is None):
            self._assign_after_with(noun)

    def _describes_room(self, noun: NounPhrase) -> bool:
        roles = [self._draft.roles.get(phrase) for phrase in self.clause.objects]
        fixed = noun.head in lexicon.COMMON_ANCHORS or self.clause.preposition == "has"
        return self.clause.in_space and fixed and TargetRole.DESTINATION not in roles

    def _assign_place(self, pending: str, noun: NounPhrase, following: Sequence[Chunk]) -> None:
        """Assign a noun after a preposition of place: a destination, or where an object or a destination is."""
        clause = self.clause
        if (clause.crosses and not clause.objects) or (clause.preposition == "has" and self._describes_room(noun)):
            return  # "take the hallway to the left of the stairs"
        if self._keeps_away(pending):
            self._draft.add_target(noun.text, TargetRole.OBSTACLE)  # "place it at least 1 m away from the stove"
            clause.last_relation = "away"
        elif clause.terms.negated and (
            self._has_destination(pending) if clause.adds_place else self._goes_on(following)
        ):
            self._draft.exclude(noun.text)  # "put it on the table, not on the shelf"
        elif pending == "far_from" and clause.verb in verbs.GO_VERBS and not (clause.objects or clause.pending_places):
            self._assign_waypoint(noun)  # "back away from the desk"
        elif clause.last_relation in ("to", "with") and clause.places:
            self._relations.relate_places(RelationTerms(pending, clause.terms.negated, clause.terms.bounds), noun)
        elif self._is_destination(pending, following):
            self._add_destination(noun)
            clause.between = pending == "between"
        elif (
            pending == "far_from"
            and clause.verb in verbs.PUSHING_VERBS | verbs.DELIVERY_VERBS
            and not clause.current_place
        ):
            self._relations.relate("near", noun)  # "pull the chair away from the wall": it is there now
        elif clause.last_relation != "for":  # "a chair for the woman by the window"
            if clause.pending_places and clause.verb in verbs.TRAVEL_VERBS:
                self._make_places_targets()  # "stop behind the car near the tree"
            self._relations.relate(pending, noun)

    def _keeps_away(self, pending: str) -> bool:
        """Return True if the clause moves to a place far from the noun, unlike "the chair far from the door"."""
        clause, moves = self.clause, verbs.DELIVERY_VERBS | verbs.TRAVEL_VERBS | verbs.PUSHING_VERBS
        fetches = clause.verb in verbs.FETCHING_VERBS and not clause.places
        if clause.current_place or clause.statement or fetches or clause.verb not in moves:
            return False
        if pending == "far_from" and not clause.places:  # "pull the chair away from the wall": it is there now
            return clause.verb in verbs.PLACE_VERBS | verbs.STOPPING_VERBS or clause.preposition != "away from"
        return replace(clause.terms, relation=pending).keeps_away

    def _has_destination(self, pending: str) -> bool:
        """Return True if the clause has a destination, and the same preposition as another that it denies."""
        places = self.clause.pending_places
        reached = any(self._draft.roles.get(phrase) is TargetRole.DESTINATION for phrase in self.clause.objects)
        goes_there = places[-1][0].relation == pending if places else reached and self.clause.preposition == "at"
        return self.clause.last_relation == "to" or (self.clause.verb in verbs.TRAVEL_VERBS and goes_there)

    def _goes_on(self, following: Sequence[Chunk]) -> bool:
        """Return True if another place follows: "put the jacket not on the chair, on the hanger"."""
        kinds = [chunk.kind for chunk in following[:2]]
        return self.clause.verb in verbs.PLACE_VERBS and kinds == [ChunkKind.CONJUNCTION, ChunkKind.PREPOSITION]

    def _assign_waypoint(self, noun: NounPhrase, conjoined: bool = False) -> None:
        if self.clause.verb in verbs.GO_VERBS:
            self._make_places_targets(passes=True)  # "to the right of the bed and through the curtain"
        if lexicon.is_space(noun.words):
            self._draft.add_context(noun.text)
        else:
            self.target(noun, TargetRole.OBJECT, conjoined)
        self.clause.route = True

    def _acts_on_people(self) -> bool:
        return self._are_people((*self.clause.objects, *self._draft.mentions[-1:]))

    def _is_destination(self, pending: str, following: Sequence[Chunk]) -> bool:
        """Return True if the preposition states where to put the objects: "put the mug on the desk"."""
        clause = self.clause
        if clause.inherits_goal and clause.objects:
            clause.inherits_goal = False
            return True
        moved = clause.verb not in verbs.LOOKING_VERBS | verbs.TOOL_VERBS | verbs.FETCHING_VERBS
        if clause.by_pronoun and moved and not clause.statement and pending in _DESTINATION_RELATIONS:
            return True  # "and line them up on the shelf"
        shifting = verbs.CARRY_VERBS if clause.preposition.endswith("side of") else _SHIFTING_VERBS
        shifts = clause.preposition.startswith("to the ") and clause.verb in shifting  # "to the left of"
        pushes = (shifts or clause.verb in verbs.PUSHING_VERBS) and bool(clause.objects)
        are_objects = any(self._draft.roles.get(phrase) is TargetRole.OBJECT for phrase in clause.objects)
        # "push the ball between the cones", unlike "push the button next to the door"
        moves = pushes and are_objects and not clause.is_part and clause.verb != "pull" and pending in _PUSHED_TO
        moves = moves and not clause.preposition.startswith("at ")
        places = moves or clause.verb in verbs.ATTACHING_VERBS | verbs.PLACE_VERBS
        return places and not clause.current_place and self._is_final_place(pending, following)

    def _add_anchor(self, relation: str, noun: NounPhrase) -> None:
        if relation == "to":
            self._add_destination(noun, conjoined=True)
        elif relation == "away":
            self._draft.add_target(noun.text, TargetRole.OBSTACLE)
        else:
            self._relations.relate(relation, noun)

    def _add_destination(self, noun: NounPhrase, conjoined: bool = False) -> None:
        self._add_place(noun, TargetRole.DESTINATION, conjoined)
        self.clause.last_relation = "to"

    def _add_place(self, noun: NounPhrase, role: TargetRole, conjoined: bool) -> None:
        self._draft.add_target(noun.text, role)
        self.clause.places = [*self.clause.places, noun.text] if conjoined else [noun.text]
        self.clause.in_space = False

    def _assign_after_with(self, noun: NounPhrase) -> None:
        """Assign the noun after "with": the hat of "find a man with a hat" is near him, a sponge is a tool."""
        clause = self.clause
        is_part = noun.head in lexicon.PARTS or noun.head in lexicon.CLOTHING
        may_be_tool = clause.verb in verbs.TOOL_VERBS or noun.head in lexicon.HELD_TOOLS
        if clause.last_relation == "to" and clause.places and (is_part or not may_be_tool):
            self._relations.relate_places(RelationTerms("near"), noun)
        elif (
            is_part
            or self._are_people(clause.objects)
            or (clause.preposition == "with" and not clause.by_pronoun and self._describes_with(noun))
        ):
            self._relations.relate("near", noun)
        else:
            self._add_place(noun, TargetRole.TOOL, conjoined=False)
            clause.last_relation = "with"

    def _describes_with(self, noun: NounPhrase) -> bool:
        verb = self.clause.verb
        handles = verb in verbs.FETCHING_VERBS | verbs.GIVING_VERBS | verbs.DELIVERY_VERBS
        looks = verb is None or verb in verbs.LOOKING_VERBS | verbs.STOPPING_VERBS
        return looks or (handles and noun.head not in lexicon.HELD_TOOLS)

    def _assign_loaded(self, noun: NounPhrase) -> None:
        """Make the noun the object and the objects so far destinations: "load the van with boxes"."""
        places, self.clause.objects = self.clause.objects, []
        self._draft.roles.update(dict.fromkeys(places, TargetRole.DESTINATION))
        self.clause.verb = "find"  # a place that follows is where the contents are
        self.target(noun, TargetRole.OBJECT)

    def _is_recipient(self, following: Sequence[Chunk]) -> bool:
        """Return True for the first noun of "hand the nurse the towel", which states the destination."""
        clause = self.clause
        while len(following) > 1 and following[0].kind is ChunkKind.PREPOSITION and following[1].kind is ChunkKind.NOUN:
            following = following[2:]  # "bring the man in the wheelchair a drink"
        follows = bool(following) and following[0].kind is ChunkKind.NOUN and following[0].word not in lexicon.PLACES
        return follows and clause.verb in verbs.GIVING_VERBS and not clause.objects

    def _is_final_place(self, pending: str, following: Sequence[Chunk]) -> bool:
        """Return True if no later place is the destination; "on the table into the sink" goes to the sink."""
        more = [chunk.word for chunk in following[:1] if chunk.kind is ChunkKind.PREPOSITION]
        unfit = lexicon.ROOMS | lexicon.PLACES
        rooms = [chunk.noun for chunk in following[1:2] if chunk.noun and chunk.noun.head in unfit]
        final = "to" in more or (pending == "on" and bool(_FINAL_DESTINATIONS.intersection(more)) and not rooms)
        return bool(self.clause.objects) and pending in _DESTINATION_RELATIONS and not final

    def _is_second_anchor(self, noun: NounPhrase) -> bool:
        """Return True for the stove in "near the sink and the stove", not for a target of its own."""
        if self.clause.last_relation in ("between", "away") or self.clause.between or self.clause.is_alternative:
            return True
        # "a couch with a throw and two cushions", unlike "the mug with a lid and the plate"
        if self.clause.describes and not noun.is_definite:
            return self.clause.verb is None or self.clause.verb in verbs.LOOKING_VERBS | verbs.STOPPING_VERBS
        return noun.head in lexicon.COMMON_ANCHORS and self.clause.last_relation not in ("on", "inside", "with")

    def role_of_object(self, head: str) -> TargetRole:
        """Return the role of a verb's direct object."""
        if self.clause.verb in verbs.AVOIDING_VERBS:
            return TargetRole.OBSTACLE
        if self.clause.verb in verbs.REACHING_VERBS | verbs.STOPPING_VERBS or (
            self.clause.verb in verbs.SPEAKING_VERBS and head in lexicon.PEOPLE
        ):
            return TargetRole.DESTINATION
        return TargetRole.TOOL if self.clause.verb == "use" else TargetRole.OBJECT

    def target(self, noun: NounPhrase, role: TargetRole, conjoined: bool = False) -> None:
        """Make the noun a target and the clause's object; a conjoined noun is added to the objects."""
        clause, phrase = self.clause, noun.text
        if lexicon.is_space(noun.words) and role is TargetRole.OBJECT and clause.verb in verbs.COVERING_VERBS:
            self._draft.add_context(phrase)  # "clean the kitchen": every object in it
            phrase = "object"
        self._draft.add_target(phrase, role, from_statement=clause.statement)
        clause.objects = [*clause.objects, phrase] if conjoined else [phrase]
        clause.conjoined, clause.by_pronoun = conjoined, False
        clause.last_relation, clause.places, clause.describes = None, [], False
        clause.superlative = noun.distance_superlative or (clause.superlative if conjoined else None)
        clause.is_part = noun.head in lexicon.PARTS
        pending_places, clause.pending_places = clause.pending_places, []
        for terms, anchor in pending_places:
            self._relations.relate_by(replace(terms, relation=terms.relation.replace("with", "near")), anchor)

    def _are_people(self, phrases: Sequence[str]) -> bool:
        return any(phrase.split()[-1] in lexicon.PEOPLE for phrase in phrases)

    def _destination(self, noun: NounPhrase) -> None:
        clause = self.clause
        if clause.verb in verbs.TRAVEL_VERBS:
            self._make_places_targets(passes=True)  # "between the shelves to the exit"
        leads, travels = clause.verb in verbs.LEADING_VERBS, clause.verb in verbs.GO_VERBS - verbs.MOVING_VERBS
        if not clause.objects or (not leads and (clause.route or travels)):
            moving = {"turn"} | verbs.TRAVEL_VERBS | verbs.DELIVERY_VERBS | verbs.SPEAKING_VERBS
            going = clause.route or clause.verb is None or clause.verb in moving
            role = TargetRole.DESTINATION if going else TargetRole.OBJECT
            self.target(noun, role, conjoined=bool(clause.objects))
            clause.route = False
        else:
            self._add_destination(noun)

    def _assign_searched_object(self, noun: NounPhrase) -> None:
        """Make the noun the target, near the searched places; a defect to inspect for is no object."""
        clause = self.clause
        if clause.objects and clause.verb in verbs.INSPECTION_VERBS and noun.head in lexicon.DEFECTS:
            return
        if clause.objects and clause.verb in verbs.SEARCH_VERBS:
            places, clause.objects = clause.objects, []
            self._draft.remove_targets(places)
            self.target(noun, TargetRole.OBJECT)
            for place in map(phrase_from_text, places):
                if place.text != "object":  # a room is context
                    self._relations.relate("inside" if place.head in lexicon.CONTAINERS else "near", place)
        elif not clause.objects:
            self.target(noun, TargetRole.OBJECT)
        elif clause.verb in verbs.FETCHING_VERBS and noun.head in lexicon.PEOPLE and noun.is_definite:
            self._add_destination(noun)
        else:
            clause.last_relation = "for"

    def _assign_after_of(self, noun: NounPhrase) -> None:
        clause = self.clause
        if not clause.objects and not clause.pending_places:
            self.target(noun, self.role_of_object(noun.head))
        elif lexicon.is_space(noun.words):
            self._draft.add_context(noun.text)
        elif clause.last_relation in ("to", "with") and clause.places:
            self._relations.relate_places(RelationTerms("near"), noun)
        elif clause.is_part or noun.has_determiner:
            self._relations.relate("near", noun)

    def _assign_origin(self, pending: str, noun: NounPhrase) -> None:
        clause = self.clause
        encloses = noun.head in lexicon.CONTAINERS or lexicon.is_space(noun.words)
        going = clause.verb in verbs.GO_VERBS - verbs.SEARCH_VERBS and not (
            clause.objects and clause.verb in verbs.LEADING_VERBS | verbs.MOVING_VERBS
        )
        if going:
            if pending == "from_inside" and not encloses and noun.head not in lexicon.ROOMS:
                self._assign_waypoint(noun, conjoined=True)  # "out of the back door"
            return
        relation = _ORIGIN_RELATIONS.get(pending, "inside" if encloses else "on")
        if clause.last_relation == "with":
            self._relations.relate_places(RelationTerms(relation), noun)
            return
        of_people = clause.verb in verbs.LEADING_VERBS or (self._are_people(clause.objects) and not encloses)
        near = pending == "from" and (noun.head in lexicon.PEOPLE or of_people)
        self._relations.relate("near" if near else relation, noun)
