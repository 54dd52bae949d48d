"""Build the graph of a chunked sentence: each noun gets a role, locates another noun, is excluded or ignored."""

from __future__ import annotations

from collections.abc import Sequence

from gausslite.domain.task import TargetRole
from gausslite_language import lexicon, verbs
from gausslite_language.chunk import Chunk, ChunkKind, NounPhrase, adjectives_only, names_object, phrase_from_text
from gausslite_language.graph_draft import Clause, GraphDraft, RelationTerms
from gausslite_language.lexicon import SUPERLATIVES, is_attribute
from gausslite_language.roles import RoleAssigner
from gausslite_language.tokens import UNBOUNDED

# with these, a room or place states where something is
_SPACE_PREPOSITIONS = frozenset(
    {"at", "around", "throughout", "across", "on", "near the middle of", "along", "through"}
)
_THOSE_THERE = [ChunkKind.DEMONSTRATIVE, ChunkKind.PREPOSITION]
# after a negation: "open no door except the red one"
_EXCEPTIONS = ("except", "besides", "apart", "aside", "other", "but", "save", "barring")


def build_draft(chunks: Sequence[Chunk]) -> GraphDraft:
    """Return the draft of a whole sentence."""
    builder = GraphBuilder()
    for at, chunk in enumerate(chunks):
        builder.add(chunks[at - 1] if at else None, chunk, chunks[at + 1 :])
    return builder.finish()


class GraphBuilder:
    """Build a draft from the chunks of one sentence, added in order."""

    def __init__(self) -> None:
        self._draft = GraphDraft()
        self._assigner = RoleAssigner(self._draft)
        self._pending: str | None = None
        self._alternative: str | None = None  # "under" in "under or behind the couch"
        self._negated = False
        self._corrects = False
        self._negated_objects: list[str] = []
        # "the largest" of "the largest of the boxes"
        self._partitive: tuple[NounPhrase, str | None, bool] | None = None
        self._described: str | None = None  # the latest object, which an attribute may describe
        self._adjectives: list[NounPhrase] = []
        self._plurals: set[str] = set()
        self._denied_places: list[tuple[str, RelationTerms, NounPhrase]] = []
        self._after_preposition: dict[str, list[str]] = {}  # the latest noun after each preposition
        self._following: Sequence[Chunk] = ()

    def add(self, before: Chunk | None, chunk: Chunk, following: Sequence[Chunk]) -> None:
        """Process one chunk, given the chunk before it and all that follow."""
        after, self._following = (following[0] if following else None), following
        if chunk.kind is ChunkKind.VERB:
            self._verb(before, chunk)
        elif chunk.kind is ChunkKind.SUBJECT_VERB:
            if chunk.word in verbs.AVOIDING_VERBS:  # "drive to the ramp, the cones must be avoided"
                subjects = self._clause.objects[-1 if self._clause.verb else 0 :]
                self._draft.roles.update(dict.fromkeys(subjects, TargetRole.OBSTACLE))
            self._clause.verb = "put" if chunk.word in verbs.BELONGING_VERBS else chunk.word
            self._clause.last_relation, self._negated = None, False
        elif chunk.kind is ChunkKind.NOUN and chunk.noun is not None:
            self._plurals |= {chunk.noun.text} if chunk.noun.is_plural else set()
            self._noun(before, chunk.noun, after)
        elif chunk.kind is ChunkKind.PREPOSITION:
            # "all but the lighter, to the tent": the exception ends here
            self._negated = self._negated and (
                before is None or before.kind is not ChunkKind.CONJUNCTION or before.word == "or"
            )
            self._alternative = self._pending if before is not None and before.kind is ChunkKind.CONJUNCTION else None
            self._preposition(before, chunk)
        elif chunk.kind is ChunkKind.NEGATION:
            self._negation(chunk.word)
        elif chunk.kind in (ChunkKind.CLAUSE_BREAK, ChunkKind.STATEMENT):
            goes_on = self._clause.verb in verbs.GO_VERBS and after is not None and after.word in ("past", "via", "to")
            self._new_clause(self._clause.verb if goes_on else None)  # "go up the steps, then past the bar"
            self._negated, self._clause.statement = False, chunk.kind is ChunkKind.STATEMENT
        elif chunk.kind is ChunkKind.ANAPHOR:
            self._resolve_back_reference(chunk.word, before)
        elif chunk.kind is ChunkKind.DEMONSTRATIVE:
            self._handle_demonstrative(chunk.word, before, after)
        elif chunk.kind is ChunkKind.NOT_UNDERSTOOD:
            self._draft.warnings.append(f"{chunk.word!r} is not understood: it is dropped")
        elif chunk.kind is ChunkKind.ATTRIBUTE:
            described = next(reversed(self._clause.objects), self._described)
            # "near the door and is not blue", "the umbrellas in the stand that are black"
            if (before is not None and before.kind is ChunkKind.CONJUNCTION) or (
                chunk.text and described in self._plurals and self._described not in self._plurals
            ):
                self._described = described
            self._describe(chunk.word, chunk.negated)

    def finish(self) -> GraphDraft:
        """Return the draft after the last clause, without excluded objects."""
        self._new_clause(None)
        for phrase, terms, noun in self._denied_places:  # "not the lamp by the bed but the lamp by the door"
            if phrase in self._draft.targets and phrase in self._draft.excluded:
                self._draft.excluded.remove(phrase)
                self._draft.add_relation(terms, [phrase], noun.text)
        self._draft.finalise()
        return self._draft

    def _preposition(self, before: Chunk | None, chunk: Chunk) -> None:
        clause = self._clause
        clause.adds_place = before is not None and before.kind is ChunkKind.CONJUNCTION
        if chunk.word == "of" and clause.skip_of_phrase:  # "around the edge of the table"
            self._pending = "of"
            return
        self._pending, clause.preposition, clause.current_place = chunk.word, chunk.text, chunk.current_place
        clause.terms = RelationTerms(chunk.word, chunk.negated, chunk.bounds or UNBOUNDED)

    def _describe(self, word: str, negated: bool) -> None:
        """Add an attribute to the latest object; a negated one excludes others: "the mug that is not red"."""
        if self._described is None:
            return
        described = f"{word} {self._described}"
        if negated:
            self._draft.exclude(described)
        else:
            self._assigner.rename(self._described, described)
            self._described = described

    def _negation(self, word: str) -> None:
        """Start an exclusion; a second negation cancels it: "ignore everything except the signs"."""
        if word == "nor" and self._negated:
            return
        if self._negated and word.startswith(_EXCEPTIONS):
            self._draft.excluded = [phrase for phrase in self._draft.excluded if phrase not in self._negated_objects]
            self._negated = False
            return
        if word not in ("not", "no", "but not", "not to") and self._clause.verb is not None:
            self._assigner.reach_places()  # "wait by the door but don't open it"
        self._corrects = word == "not" and not self._draft.targets
        self._negate()

    def _negate(self) -> None:
        self._pending, self._negated, self._negated_objects = None, True, []
        self._clause.nouns_since_negation = 0
        self._clause.verb_since_negation = False

    def _leave_excludes(self, before: Chunk | None) -> bool:
        """Return True if "leave" excludes its object, as in "take the cups and leave the plates"."""
        rest = [chunk.kind for chunk in self._following if chunk.kind not in (ChunkKind.NOUN, ChunkKind.CONJUNCTION)]
        named = bool(self._following) and self._following[0].kind is ChunkKind.NOUN
        # "leave the green ones on the vine", "leave those in the pots"
        kinds = [chunk.kind for chunk in self._following[:2]]
        contrasts = (named and self._following[0].word in ("one", "ones")) or kinds == _THOSE_THERE
        if contrasts or (named and before is not None and before.word == "but"):
            return True  # "but leave the plates on the table"
        return named and (not rest or rest[0] in (ChunkKind.CLAUSE_BREAK, ChunkKind.VERB))

    def _verb(self, before: Chunk | None, chunk: Chunk) -> None:
        is_kept = chunk.word == "keep" and before is not None and before.word == "but"
        is_leave = (chunk.word == "leave" or is_kept) and not self._clause.statement
        # "leave the jug, take the cup"
        later = next((chunk.word for chunk in self._following if chunk.kind is ChunkKind.VERB), "")
        chooses = self._draft.targets or later in ("take", "bring", "pick", "grab", "get", "fetch")
        if is_leave and chooses and self._leave_excludes(before):
            self._negate()
            return
        joined = before is not None and before.kind is ChunkKind.CONJUNCTION
        same_negation = self._negated and (
            # "don't turn left, go to the table"
            (self._clause.nouns_since_negation == 0 and not (joined and self._clause.verb_since_negation))
            or chunk.gerund
            or (joined and before is not None and before.word == "or")
        )
        if not same_negation:
            self._negated = False
        self._pending, self._adjectives = None, []
        self._clause.verb_since_negation = True
        clause_has_nouns = self._clause.objects or (self._clause.pending_places and self._clause.verb)
        if not same_negation and clause_has_nouns:
            self._new_clause(chunk.word)
        else:
            self._assigner.leave_context()
            self._clause.verb, self._clause.crosses = chunk.word, False

    def _new_clause(self, verb: str | None) -> None:
        next_verb = verb or next((chunk.word for chunk in self._following if chunk.kind is ChunkKind.VERB), None)
        self._assigner.end_clause(verb, next_verb)
        self._pending = None

    @property
    def _clause(self) -> Clause:
        return self._assigner.clause

    def _resolve_back_reference(self, word: str, before: Chunk | None) -> None:
        """Resolve "it" or "them": the clause's objects, or after a preposition the objects named before these."""
        clause = self._clause
        is_object = before is not None and before.kind is ChunkKind.VERB
        refers_to_none = is_object and not clause.referents and not clause.objects
        if refers_to_none and not self._negated and self._negated_objects[:1] == self._draft.excluded[:1] != []:
            clause.referents = [self._draft.excluded.pop(0)]  # "don't put the knife in the dishwasher, wash it"
            self._draft.add_target(clause.referents[0])
        elif refers_to_none:
            self._handle_demonstrative(word, before, None)
            return
        pending, self._pending = self._pending, None
        if pending is not None and clause.terms.negated and clause.places:
            words = f"not {clause.preposition} {word}"  # "beside the sink, not in it"
            self._draft.warnings.append(f"{words!r} is not understood: it is dropped")
            return
        if self._negated:
            self._deny_reference(pending)
            return
        if pending is None:
            clause.objects = clause.objects or list(clause.referents)
            self._described = next(reversed(clause.objects), self._described)
            if not clause.statement:
                clause.by_pronoun = bool(clause.verb and clause.objects)
                self._draft.confirm_targets(clause.objects, self._assigner.role_of_object(""))
            return
        if clause.verb in verbs.TRAVEL_VERBS and not clause.objects and clause.referents:
            for phrase in clause.referents:
                self._assigner.assign_by_preposition(pending, phrase_from_text(phrase))
            return
        named, subjects = (clause.objects[:-1], clause.objects[-1:]) if clause.conjoined else (
            clause.referents or self._draft.targets[-2:-1], clause.objects
        )  # fmt: skip
        if named and subjects:
            clause.objects = subjects
            if pending == "with":
                self._draft.roles.update(dict.fromkeys(named, TargetRole.TOOL))  # "wipe the table with it"
                return
            for phrase in named:
                self._assigner.assign_by_preposition(pending, phrase_from_text(phrase))

    def _deny_reference(self, pending: str | None) -> None:
        named = (self._clause.objects or self._clause.referents)[-1:]
        if pending is not None and named:
            self._place_negated(phrase_from_text(named[0]), pending)

    def _handle_demonstrative(self, word: str, before: Chunk | None, after: Chunk | None) -> None:
        """Handle a "this" without a noun."""
        if self._negated:
            self._negate_latest()
            self._clause.nouns_since_negation += 1
            return
        names_more = self._pending is None and after is not None and after.kind is ChunkKind.PREPOSITION
        if (self._clause.verb is None and self._pending is None) or (names_more and self._clause.objects):
            return  # "the tiles, especially those behind the toilet"
        self._draft.unnamed = self._draft.unnamed or word
        if self._pending is None:
            self._noun(before, phrase_from_text("object"), after)
        self._pending = None

    def _noun(self, before: Chunk | None, noun: NounPhrase, after: Chunk | None) -> None:
        conjoined = before is not None and before.kind is ChunkKind.CONJUNCTION
        self._clause.is_alternative = conjoined and before is not None and before.word == "or"
        contrasts = self._corrects or (before is not None and before.word in ("but", "("))
        if conjoined and contrasts and self._clause.nouns_since_negation:
            self._negated = False  # "not the wooden spoon, the metal one", "not the red one but the blue one"
        if noun.head in ("one", "ones"):
            if self._negated and len(noun.words) == 1:
                self._negate_latest()  # "this mug, not that one"
                return
            noun = self._resolve_one(noun, before)
        pending, self._pending = self._pending, None
        is_picture = bool(self._described) and (self._described or "").split()[-1] in lexicon.PICTURES
        if pending == "of" and not self._clause.skip_of_phrase and is_picture:
            self._draft.warnings.append(f"what {self._described!r} shows is not understood: {noun.text!r} is dropped")
            return
        if self._partitive is not None and pending in (None, "of"):
            (superlative, pending, conjoined), self._partitive = self._partitive, None
            noun = NounPhrase((*superlative.words, *noun.words), True)
        of_follows = after is not None and after.kind is ChunkKind.PREPOSITION and after.word == "of"
        if adjectives_only(noun.words) and not (of_follows and noun.head in lexicon.PLACES):
            self._lone_adjectives(noun, pending, conjoined, after)
            return
        if not names_object(noun, pending, self._following, self._clause.verb):
            self._skip_noun(noun, pending, conjoined, after)
            return
        in_space = lexicon.is_space(noun.words) and self._clause.preposition in _SPACE_PREPOSITIONS
        self._assign_listed(noun, "inside" if in_space and pending not in (None, "via") else pending, conjoined)

    def _assign_listed(self, noun: NounPhrase, pending: str | None, conjoined: bool) -> None:
        """Assign or exclude the noun, and the adjectives before it that share it."""
        nouns = [*(_with_shared_head(adjective, noun) for adjective in self._adjectives), noun]
        self._adjectives = []
        for listed in nouns:
            goes = pending == "to" or (self._clause.verb in verbs.PLACE_VERBS and not self._clause.current_place)
            excepted = bool(self._negated_objects) and self._negated_objects[-1] in self._draft.excluded
            goes = goes and not self._clause.places and not self._clause.verb_since_negation and excepted
            if self._negated and pending and goes:
                self._negated = False  # "bring everything except the knife to the sink"
            if self._negated:
                self._exclude(listed, pending)
            else:
                if pending is not None and not lexicon.is_space(listed.words):
                    self._after_preposition[self._clause.preposition] = [listed.text]
                self._assigner.assign(listed, pending, conjoined, self._following)
                self._described = listed.text
                if self._alternative is not None:
                    self._assigner.assign_by_preposition(self._alternative, listed)
        self._alternative = None

    def _lone_adjectives(self, noun: NounPhrase, pending: str | None, conjoined: bool, after: Chunk | None) -> None:
        """Handle adjectives without a noun: "the red" and blue mugs, "the largest" of the boxes."""
        before_noun = after is not None and (after.kind is ChunkKind.NOUN or after.word == "of")
        kinds = [chunk.kind for chunk in self._following[:2]]
        if kinds in ([ChunkKind.CONJUNCTION, ChunkKind.NOUN], [ChunkKind.NEGATION, ChunkKind.NOUN]):
            self._adjectives.append(noun)  # "the red and blue mugs", "neither the red nor the blue mug"
        elif is_attribute(noun.head) and before_noun:
            self._partitive = noun, pending, conjoined
        elif any(word in SUPERLATIVES for word in noun.words) and self._described is not None:
            self._describe(" ".join(word for word in noun.words if is_attribute(word)), negated=False)

    def _resolve_one(self, one: NounPhrase, before: Chunk | None) -> NounPhrase:
        """Return the phrase with the latest object's noun in place of "one": "the blue one"."""
        clause = self._clause
        # "with the blue cloth, not with the yellow one"
        replaced = clause.places if (self._pending and clause.terms.negated) or clause.last_relation == "with" else []
        replaced = replaced or self._after_preposition.get(clause.preposition if self._pending else "", [])
        named = replaced or clause.objects or clause.referents or self._draft.targets or self._draft.excluded
        ahead = [chunk.noun.text for chunk in self._following if chunk.noun and chunk.noun.head not in ("one", "ones")]
        named = named or (ahead[:1] if self._negated else []) or ["object"]
        *adjectives, head = named[-1].split()
        nouns = [*(word for word in adjectives if not adjectives_only((word,))), head]
        same = phrase_from_text(" ".join(nouns))
        if len(one.words) == 1:
            return phrase_from_text(named[-1])
        described = NounPhrase((*one.words[:-1], *same.words), one.has_determiner)
        listed = [chunk.kind for chunk in self._following[:2]] == [ChunkKind.CONJUNCTION, ChunkKind.NOUN]
        # "which jacket, the black one"
        joint = before.word if before is not None else ""  # "(" stands for "but only"
        repeats = joint in (",", "(") and named[-1] in clause.objects and one.is_definite
        repeats = repeats and (joint == "(" or not one.is_plural) and named[-1] == same.text and not listed
        # "there are two mugs on the table, take the red one"
        repeats = repeats or self._draft.is_from_statement(named[-1])
        if self._pending in (None, "purpose") and not self._negated and repeats:
            self._assigner.rename(named[-1], described.text)
        return described

    def _skip_noun(self, noun: NounPhrase, pending: str | None, conjoined: bool, after: Chunk | None) -> None:
        """Skip a noun that names no object; in "on the edge of the table" the table inherits the "on"."""
        of_follows = after is not None and after.kind is ChunkKind.PREPOSITION and after.word == "of"
        if pending is not None and self._clause.terms.negated and not of_follows:
            words = f"not {self._clause.preposition} {noun.text}"
            self._draft.warnings.append(f"{words!r} is not understood: it is dropped")
        is_located = after is not None and after.kind is ChunkKind.PREPOSITION
        is_located = is_located and self._following[:2][-1].word not in lexicon.PLACES  # "into the spot behind the bin"
        goes_there = pending in ("to", "on", "inside") and self._clause.verb in verbs.DELIVERY_VERBS
        if goes_there and noun.has_determiner and noun.head in lexicon.PLACES and not is_located:
            self._draft.warnings.append(f"{noun.text!r} is not part of the task")  # "drop them into the zone"
        self._clause.in_space = noun.head == "room"
        if noun.head in lexicon.ROUTES:
            self._clause.route = True
        elif noun.head in lexicon.PLACES and pending is None:
            self._draft.whole_place = noun.text
        self._clause.inherited_preposition = pending if of_follows else None
        enters = pending is None and self._clause.verb in verbs.REACHING_VERBS
        self._clause.inherits_goal = (pending == "to" or enters) and not of_follows  # "to the spot behind the truck"
        self._clause.skip_of_phrase, self._clause.inherited_conjoined = of_follows, conjoined

    def _negate_latest(self) -> None:
        """Remember the objects of "except those on the shelf", whose place follows."""
        if not self._negated_objects and self._pending is None:
            self._negated_objects = list(self._clause.objects or self._draft.targets[-1:])

    def _exclude(self, noun: NounPhrase, pending: str | None) -> None:
        """Exclude the noun, or make it an obstacle if the negated verb means contact or harm."""
        clause = self._clause
        direct = pending is None or (clause.nouns_since_negation == 0 and clause.verb_since_negation)
        clause.nouns_since_negation += 1
        if not direct:
            self._place_negated(noun, pending or "near")
        elif clause.verb_since_negation and self._may_harm(pending):
            self._draft.add_target(noun.text, TargetRole.OBSTACLE)
            self._negated_objects.append(noun.text)
        else:
            self._draft.exclude(noun.text)
            self._negated_objects.append(noun.text)

    def _may_harm(self, pending: str | None) -> bool:
        """Return True for "don't touch", and for "don't go near" or "over", unlike "don't go to"."""
        goes_near = self._clause.verb in verbs.GO_VERBS and pending in ("near", "on", "above", "past", "via")
        return goes_near or self._clause.verb in verbs.CONTACT_VERBS

    def _place_negated(self, noun: NounPhrase, relation: str) -> None:
        """Relate an obstacle to its place; "the mugs except the one on the shelf" negates the relation."""
        terms = self._clause.terms
        objects = self._negated_objects or (self._clause.referents if self._clause.verb is None else [])
        relation = "near" if relation == "with" else relation
        if objects and all(self._draft.roles.get(phrase) is TargetRole.OBSTACLE for phrase in objects):
            self._draft.add_relation(RelationTerms(relation, terms.negated, terms.bounds), objects, noun.text)
        elif objects and all(phrase in self._draft.targets for phrase in objects) and not lexicon.is_space(noun.words):
            self._draft.excluded = [phrase for phrase in self._draft.excluded if phrase not in objects]
            self._draft.add_relation(RelationTerms(relation, not terms.negated, terms.bounds), objects, noun.text)
        else:
            if (self._clause.verb in verbs.PLACE_VERBS or relation == "to") and self._clause.verb_since_negation:
                self._draft.exclude(noun.text)
                return
            self._denied_places += [(phrase, RelationTerms(relation, True, terms.bounds), noun) for phrase in objects]
            self._draft.warnings.append(f"an exception by place ({noun.text!r}) is not supported: it is dropped")


def _with_shared_head(adjective: NounPhrase, noun: NounPhrase) -> NounPhrase:
    """Return the adjective with the noun's head: in "red and blue mugs", "red" becomes "red mug"."""
    words = adjective.words[:-1] if adjective.head in ("one", "ones") else adjective.words
    return NounPhrase((*words, noun.head), adjective.has_determiner)
