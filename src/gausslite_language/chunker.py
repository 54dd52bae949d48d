"""Chunk a sentence into verbs, noun phrases, prepositions and conjunctions (shallow parsing)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

from gausslite_language import lexicon, verbs
from gausslite_language.chunk import Chunk, ChunkBuffer, ChunkKind
from gausslite_language.clause_types import (
    SUBJECT_PRONOUNS,
    SUBJECT_TAGS,
    UNKNOWN_PEOPLE,
    WISHES,
    ClauseType,
    clause_types,
    is_command,
    is_modal,
    is_question_subject,
)
from gausslite_language.correction import apply_corrections
from gausslite_language.lexicon import is_attribute, is_ordinal, singular, word_set
from gausslite_language.negation import HAVE_FORMS, NOUN_PHRASE_TAGS, OBJECT_START_TAGS, chunk_negation
from gausslite_language.nouns import is_kind_of
from gausslite_language.tags import Tag
from gausslite_language.tokens import PREPOSITIONS, split_bounds

_RELATIVES: Final = word_set("that which who whom")
_BEFORE_GERUND_TAGS: Final = frozenset({Tag.NOUN, Tag.PREPOSITION, Tag.NEGATION, Tag.VERB, Tag.AUXILIARY})
_OBJECT_TAGS: Final = OBJECT_START_TAGS | {Tag.PRONOUN, Tag.ANAPHOR}
_SUBJECT_KINDS: Final = (ChunkKind.NOUN, ChunkKind.PREPOSITION)
_PERMISSIONS: Final = word_set("may can could")
_PLACING: Final = verbs.DELIVERY_VERBS | verbs.GIVING_VERBS | verbs.FILLING_VERBS | verbs.PUSHING_VERBS
_OBJECT_PHRASE_TAGS: Final = OBJECT_START_TAGS | {Tag.ANAPHOR}
_DO_FORMS: Final = word_set("do does did")
_NAMING: Final = word_set("label mark name call tag")
_PASSING: Final = verbs.LEAVING_VERBS | {"keep"}
_ACTING: Final = verbs.HOLDING_VERBS | verbs.GO_VERBS | _PASSING
_BELONGING_TAGS: Final = frozenset({Tag.NOUN, Tag.INDEFINITE, Tag.ANAPHOR, Tag.PARTICIPLE})


class VerbChunker:
    """Handles the verb forms of a sentence; its subject and its modal verb decide what a verb means."""

    def __init__(self, buffer: ChunkBuffer) -> None:
        self._buffer = buffer
        self._after_modal = False
        self._relative_chunk: int | None = None
        self.describes = False

    def relative(self, word: str) -> None:
        """Remember where a relative clause starts."""
        self._buffer.close()
        if word in _RELATIVES and self._buffer.last_kind() is ChunkKind.NOUN:
            self._relative_chunk = len(self._buffer.chunks)

    def auxiliary(self, word: str) -> None:
        """Handle "is", "has" and the like; "has" with an object means near."""
        buffer = self._buffer
        self._end_relative_subject(finite=True)
        continues = buffer.tag(-1) is Tag.RELATIVE and buffer.last_kind() is ChunkKind.CONJUNCTION  # "and which has"
        if (
            word in HAVE_FORMS
            and (continues or buffer.last_kind() is ChunkKind.NOUN or (self.describes and buffer.word(-1) == "it"))
            and buffer.tag(1) in OBJECT_START_TAGS
        ):
            buffer.emit_preposition("near", "has", current_place=True)
        if word != "be":  # "should be moved to the bench"
            requires = is_modal(buffer.tagged, buffer.index) or (word in _PERMISSIONS and self._denied_subject() > 0)
            self._after_modal = requires and buffer.last_kind() is ChunkKind.NOUN

    def verb(self, word: str) -> None:
        """Emit an instruction; a verb of a subordinate clause relates its object to its subject."""
        buffer = self._buffer
        self._end_relative_subject(finite=True)
        base = verbs.verb_base(word) or word
        if buffer.negates_next:
            self._negated_verb(base)
            return
        if buffer.word(-3) == "what" or (buffer.index == 1 and buffer.word(-1) == "who"):
            buffer.close()  # "what did you see on the shelf", "who put the ladder there"
            return
        subject, tagged, index = buffer.tag(-1), buffer.tagged, buffer.index
        is_required = self._after_modal
        self._after_modal = is_modal(tagged, index) and subject in SUBJECT_TAGS
        is_wish = subject is Tag.PRONOUN and base in WISHES
        belongs = base in verbs.BELONGING_VERBS and word.startswith(base) and subject in _BELONGING_TAGS
        if subject is Tag.INFINITIVE and buffer.tag(-2) is Tag.INDEFINITE and buffer.tag(1) not in OBJECT_START_TAGS:
            buffer.close()  # "something to write with"
        elif is_required and self._subject_is_object():
            if base in verbs.BELONGING_VERBS or buffer.word(-1) == "be":
                self._require(base)
        elif belongs and not is_command(tagged, index):
            buffer.emit(ChunkKind.SUBJECT_VERB, base)
        elif subject not in SUBJECT_TAGS or is_wish or is_command(tagged, index):
            buffer.emit(ChunkKind.VERB, base)
        elif subject in (Tag.NOUN, Tag.RELATIVE, Tag.INDEFINITE) and buffer.tag(1) in _OBJECT_TAGS:
            self._subordinate_verb(base)
        else:
            buffer.close()

    def gerund(self, word: str) -> None:
        """Handle an -ing form: an adjective, an instruction, or a relation of the noun before it."""
        buffer = self._buffer
        before, after = buffer.tag(-1), buffer.tag(1)
        if buffer.negates_next:
            self._negated_verb(verbs.verb_base(word) or word)
            return
        can_start = buffer.has_determiner or before not in _BEFORE_GERUND_TAGS
        follows_verb = before is Tag.VERB and buffer.last_kind() is ChunkKind.VERB
        can_start = can_start or (follows_verb and buffer.chunks[-1].word not in verbs.ASPECT_VERBS)
        if can_start and after in NOUN_PHRASE_TAGS and lexicon.ADJECTIVES.issuperset(buffer.words):
            buffer.words.append(word)  # "the leaking pipe"
        elif buffer.words and before is Tag.NOUN and self._is_compound(verbs.base_of_ing(word)):
            buffer.words.append(word)  # "the label printing table"
        elif (
            before is Tag.NOUN
            and verbs.base_of_ing(word) in _PASSING
            and verbs.verb_base(buffer.last_verb()) in verbs.GO_VERBS
        ):
            buffer.emit(ChunkKind.VERB, verbs.verb_base(word) or word)  # "walk along the hall keeping the wall"
        elif before is Tag.CONJUNCTION and verbs.base_of_ing(word) in verbs.RESTING_VERBS and after is Tag.PREPOSITION:
            buffer.chunks.pop()  # "the wrench, lying beside the toolbox"
        elif buffer.words or before in (Tag.NOUN, Tag.INDEFINITE, Tag.AUXILIARY, Tag.RELATIVE):
            self._gerund_after_noun(after)
        else:
            buffer.emit(ChunkKind.VERB, verbs.verb_base(word) or word, gerund=True)

    def _is_compound(self, base: str | None) -> bool:
        """Return True if a countable noun follows without a determiner, and the noun before is no animate being."""
        noun, after = singular(self._buffer.words[-1]), self._buffer.word(1)
        acts = base in _ACTING or noun in lexicon.PEOPLE or is_kind_of(noun, "animal")
        is_mass = singular(after) != after or is_kind_of(after, "liquid") or is_kind_of(after, "material")
        return self._buffer.tag(1) is Tag.NOUN and not (is_mass or acts or is_kind_of(noun, "person"))

    def participle(self, word: str) -> None:
        """Handle a participle: an adjective, a required state, or a modifier of the noun before it."""
        buffer = self._buffer
        before, after = buffer.tag(-1), buffer.tag(1)
        if after in NOUN_PHRASE_TAGS and before not in (Tag.NOUN, Tag.INDEFINITE, Tag.PRONOUN):
            buffer.words.append(word)
            return
        gives = buffer.last_verb() in verbs.GIVING_VERBS
        self._end_relative_subject(finite=after is Tag.PRONOUN or before is Tag.INDEFINITE or not gives)
        if self._after_modal and self._subject_is_object():
            self._require(verbs.verb_base(word) or word)
        elif verbs.base_of_ed(word) in _PLACING and self._asks_for_state():
            buffer.emit(ChunkKind.SUBJECT_VERB, verbs.verb_base(word) or word)
        elif after in OBJECT_START_TAGS and buffer.last_kind() is ChunkKind.NOUN and before is not Tag.AUXILIARY:
            if verbs.base_of_ed(word) in _NAMING:
                buffer.emit_preposition("purpose")  # "the drum labelled acid"
            else:
                buffer.chunks.pop()  # "the toy my son dropped": the son is irrelevant
        self._after_modal = False

    def _asks_for_state(self) -> bool:
        """Return True after "can I have the chairs", "I want the chairs", and "get the chairs" with "into"."""
        buffer, at = self._buffer, self._buffer.index - 1
        while at > 0 and buffer.tagged[at][1] in _OBJECT_PHRASE_TAGS:
            at -= 1
        verb, before = buffer.tagged[at][0], [("", None), ("", None), *buffer.tagged[:at]][-2:]
        if verb == "get" or at == buffer.index - 1:
            return at < buffer.index - 1 and PREPOSITIONS.get(buffer.word(1)) == "to"
        asked = before[0][1] is Tag.AUXILIARY and before[0][0] not in _DO_FORMS
        states = before[1][1] in SUBJECT_TAGS and not asked  # "I have boxes stacked"
        return verb in WISHES or (verb == "have" and not states)

    def _require(self, base: str) -> None:
        """Emit the verb of "the box must be moved"; of "no box may be moved", negate it before its subject."""
        denied_at = self._denied_subject()
        if denied_at:
            self._buffer.chunks.insert(denied_at, Chunk(ChunkKind.VERB, base, gerund=True))
        else:
            self._buffer.emit(ChunkKind.SUBJECT_VERB, base)

    def _denied_subject(self) -> int:
        """Return where the subject of "no box on the table may" starts; 0 for one that is not denied."""
        chunks, start = self._buffer.chunks, len(self._buffer.chunks)
        while start and (chunks[start - 1].word == "nor" or chunks[start - 1].kind in _SUBJECT_KINDS):
            start -= 1
        return start if start and chunks[start - 1].kind is ChunkKind.NEGATION else 0

    def _negated_verb(self, base: str) -> None:
        """Skip the verb of "that is not standing on"; "who does not wear a helmet" means not near it."""
        self._buffer.close()
        if base in verbs.HOLDING_VERBS:
            self._buffer.emit_preposition("near", current_place=True)

    def _end_relative_subject(self, finite: bool) -> None:
        """Remove the subject of a relative clause: the wife in "the mug (that) my wife uses"."""
        buffer = self._buffer
        buffer.close()
        adjacent = (
            buffer.determiner_at > 0
            and buffer.tag(-1) is not Tag.RELATIVE
            and buffer.tagged[buffer.determiner_at - 1][1] is Tag.NOUN
        )
        if finite and adjacent and [chunk.kind for chunk in buffer.chunks[-2:]] == [ChunkKind.NOUN, ChunkKind.NOUN]:
            buffer.chunks.pop()
        if self._relative_chunk is not None and self._relative_chunk == len(buffer.chunks) - 1:
            buffer.chunks.pop()
        self._relative_chunk = None

    def _subordinate_verb(self, base: str) -> None:
        """Handle the verb of a subordinate clause: "holds" in "the shelf that holds the cans" means near."""
        buffer = self._buffer
        buffer.close()
        if base in verbs.HOLDING_VERBS:
            buffer.emit_preposition("near", current_place=True)
        elif buffer.last_kind() is ChunkKind.NOUN and (
            buffer.tag(-1) is Tag.INDEFINITE or is_question_subject(buffer.tagged, buffer.index - 1)
        ):
            buffer.chunks.pop()  # "did the courier leave the envelope"
        else:
            buffer.emit_preposition("purpose")

    def _subject_is_object(self) -> bool:
        noun = self._buffer.chunks[-1].noun if self._buffer.chunks else None
        return noun is not None and noun.head not in lexicon.ADDRESSEES

    def _gerund_after_noun(self, after: Tag | None) -> None:
        """Relate the object of the gerund: "the person holding a cup" is near the cup."""
        if after in OBJECT_START_TAGS:
            self._buffer.emit_preposition("near", current_place=True)
        else:
            self._buffer.close()


_DEMONSTRATIVES: Final = word_set("this that these those")
# "go around the table to the sofa": the table is a waypoint, the sofa the goal
_ROUTE_RELATIONS: Final = word_set("near past above")
# "the drawer open", "is empty"
_BEFORE_STATE_TAGS: Final = frozenset({Tag.NOUN, Tag.INDEFINITE, Tag.AUXILIARY})
# tags before a preposition that states where something is, not where to put it
_LOCATION_TAGS: Final = frozenset({Tag.AUXILIARY, Tag.RELATIVE, Tag.PARTICIPLE, Tag.GERUND, Tag.NEGATION})
_OBSERVERS: Final = word_set("me you us")
_THEY: Final = word_set("they he she")


def chunk_tagged(tagged: Sequence[tuple[str, Tag]]) -> list[Chunk]:
    """Return the chunks of the tagged words of a sentence, in order."""
    return apply_corrections(_Chunker(tagged).run())


class _Chunker:
    """Chunk tagged words in one pass."""

    def __init__(self, tagged: Sequence[tuple[str, Tag]]) -> None:
        self._buffer = ChunkBuffer(tagged)
        self._verbs = VerbChunker(self._buffer)
        self._clause_types = clause_types(tagged)
        self._is_statement = False
        self._handlers: dict[Tag, Callable[[str], None]] = {
            Tag.NOUN: self._noun,
            Tag.ADJECTIVE: self._adjective,
            Tag.DETERMINER: self._determiner,
            Tag.VERB: self._verbs.verb,
            Tag.GERUND: self._verbs.gerund,
            Tag.PARTICIPLE: self._verbs.participle,
            Tag.PREPOSITION: self._preposition,
            Tag.CONJUNCTION: lambda word: self._buffer.emit(ChunkKind.CONJUNCTION, word),
            Tag.CLAUSE_BREAK: self._clause_break,
            Tag.INDEFINITE: self._indefinite,
            Tag.AUXILIARY: self._verbs.auxiliary,
            Tag.RELATIVE: self._verbs.relative,
            Tag.PRONOUN: self._pronoun,
            Tag.ANAPHOR: self._anaphor,
            Tag.NEGATION: lambda word: chunk_negation(self._buffer, word),
        }

    def run(self) -> list[Chunk]:
        """Return the chunks of all words; clauses that give a reason are skipped."""
        buffer, clause = self._buffer, ClauseType.REQUEST
        for index, (word, tag) in enumerate(buffer.tagged):
            buffer.index = index
            previous, clause = clause, self._clause_types.get(index, clause)
            self._is_statement = self._verbs.describes = clause is ClauseType.STATEMENT
            starts_request = previous is ClauseType.STATEMENT or self._starts_question(index)
            if tag is Tag.CONJUNCTION and clause is ClauseType.REQUEST and starts_request:
                tag = Tag.CLAUSE_BREAK
            if clause is ClauseType.STATEMENT and index in self._clause_types:
                buffer.emit(ChunkKind.STATEMENT, word)
                if tag in (Tag.CLAUSE_BREAK, Tag.CONJUNCTION):
                    continue
            if clause is not ClauseType.REASON:
                self._handlers.get(tag, self._skip)(word)
        buffer.close()
        return buffer.chunks

    def _starts_question(self, index: int) -> bool:
        """Return True for "if it is no trouble, could you come": the question starts a new sentence."""
        return index in self._clause_types and self._buffer.tag(1) is Tag.AUXILIARY

    def _skip(self, _word: str) -> None:
        self._buffer.close()

    def _noun(self, word: str) -> None:
        buffer = self._buffer
        buffer.words.append(word)

    def _adjective(self, word: str) -> None:
        buffer = self._buffer
        if word.endswith(("'s", "s'")):
            self._determiner(word)
            buffer.words = []
        elif buffer.tag(-1) is Tag.NEGATION and not buffer.negates_next and buffer.tag(1) not in NOUN_PHRASE_TAGS:
            buffer.close()  # "that is not broken"
        elif (buffer.tag(-1) in _BEFORE_STATE_TAGS or self._joins_state()) and buffer.tag(1) not in NOUN_PHRASE_TAGS:
            buffer.close()
            self._state(word)
        elif buffer.negates_next:
            self._state(word)
        else:
            buffer.words.append(word)

    def _joins_state(self) -> bool:
        """Return True for the "brown" of "it is long and brown", and of "that is not long or brown"."""
        tags = [self._buffer.tag(offset) for offset in (-1, -2, -3)]
        return tags[:2] == [Tag.CONJUNCTION, Tag.ADJECTIVE] and tags[2] in (Tag.AUXILIARY, Tag.NEGATION)

    def _state(self, word: str) -> None:
        """Emit the colour of "the mug that is red" or "anything red"; other states describe no object ("is empty")."""
        buffer = self._buffer
        at = -3 if self._joins_state() else -1
        before = buffer.tag(at), buffer.tag(at - 1)
        follows_noun = Tag.INDEFINITE in before or Tag.RELATIVE in (buffer.tag(at - 1), buffer.tag(at - 2))
        is_it = self._is_statement and before == (Tag.AUXILIARY, Tag.ANAPHOR)  # "it is black"
        is_description = not any(other in (Tag.VERB, Tag.INDEFINITE) for _, other in buffer.tagged)
        follows_noun = follows_noun or ((self._is_statement or is_description) and before == (Tag.AUXILIARY, Tag.NOUN))
        if is_attribute(word) and (
            is_it or (follows_noun and buffer.last_kind() in (ChunkKind.NOUN, ChunkKind.CONJUNCTION))
        ):
            plural = "are" if "are" in (buffer.word(at), buffer.word(at - 1)) else ""
            negated = buffer.negates_next or buffer.joins_negated(-2)
            buffer.chunks.append(Chunk(ChunkKind.ATTRIBUTE, word, negated=negated, text=plural))
        buffer.negates_next = False

    def _determiner(self, word: str) -> None:
        buffer = self._buffer
        if word.endswith(("'s", "s'")):
            buffer.words = []
        buffer.close()
        buffer.has_determiner, buffer.determiner_at = True, buffer.index
        is_extreme = word == "most" and buffer.word(-1) == "the"
        if is_extreme or (is_ordinal(word) and buffer.tag(1) in NOUN_PHRASE_TAGS):
            buffer.words.append(word)

    def _indefinite(self, word: str) -> None:
        buffer = self._buffer
        buffer.close()
        buffer.determiner_at = buffer.index
        if self._is_statement and word in UNKNOWN_PEOPLE and buffer.tag(1) in (Tag.VERB, Tag.PARTICIPLE):
            return  # "someone knocked over the plant"
        asked = [buffer.tag(offset) for offset in (2, 3, 4)]
        if word == "what" and asked == [Tag.PRONOUN, Tag.VERB, Tag.PREPOSITION]:
            buffer.emit(ChunkKind.VERB, "find")  # "what did I put in the drawer"
        # "what does the sign say", "what is that thing", "who is the man"
        elif word in ("what", "who") and (
            buffer.word(1) in _DO_FORMS or (buffer.tag(2) in OBJECT_START_TAGS and buffer.tag(1) is Tag.AUXILIARY)
        ):
            return
        denies = word in ("nothing", "nobody")
        if denies and buffer.last_kind() in (None, ChunkKind.CLAUSE_BREAK, ChunkKind.CONJUNCTION):
            buffer.emit(ChunkKind.NEGATION, "no")  # "nothing on the altar may be moved"
            if word == "nobody":
                return
        elif denies and buffer.last_kind() in (ChunkKind.PREPOSITION, ChunkKind.NOUN):
            if buffer.last_kind() is ChunkKind.PREPOSITION:
                buffer.chunks.pop()  # "the crate that has nothing on it"
            buffer.emit(ChunkKind.NOT_UNDERSTOOD, word)
            return
        buffer.words.append(lexicon.INDEFINITE_PRONOUNS.get(word, "person"))
        buffer.close()

    def _anaphor(self, word: str) -> None:
        self._buffer.emit(ChunkKind.DEMONSTRATIVE if word in _DEMONSTRATIVES else ChunkKind.ANAPHOR, word)

    def _clause_break(self, word: str) -> None:
        self._buffer.close()
        if word != "that":
            self._buffer.emit(ChunkKind.CLAUSE_BREAK, word)

    def _pronoun(self, word: str) -> None:
        """Start a new clause at the pronoun of "ignore the cars, I only want the bikes"."""
        buffer = self._buffer
        buffer.close()
        if buffer.tag(-1) is Tag.PREPOSITION and buffer.last_kind() is ChunkKind.PREPOSITION:
            self._drop_preposition_of_pronoun(word)
        after_conjunction = buffer.last_kind() is ChunkKind.CONJUNCTION and buffer.index - 1 in self._clause_types
        if word in _THEY and self._states_place():
            buffer.emit(ChunkKind.ANAPHOR, word)
        elif after_conjunction and word in SUBJECT_PRONOUNS:
            buffer.emit(ChunkKind.CLAUSE_BREAK, word)

    def _drop_preposition_of_pronoun(self, word: str) -> None:
        """Drop the "to" of "bring to me the mug"; "nearest to me" is an attribute."""
        buffer = self._buffer
        preposition = buffer.chunks.pop()
        superlative = {"closest_to": "nearest", "farthest_from": "farthest"}.get(preposition.word)
        if superlative is not None and word in _OBSERVERS and buffer.last_kind() is ChunkKind.NOUN:
            buffer.chunks.append(Chunk(ChunkKind.ATTRIBUTE, superlative, negated=preposition.negated))

    def _states_place(self) -> bool:
        """Return True if a place follows the pronoun: "they should be on the nightstand"."""
        offset = 1
        while self._buffer.tag(offset) in (Tag.AUXILIARY, Tag.NEGATION, Tag.GERUND, Tag.PARTICIPLE):
            offset += 1
        return offset > 1 and self._buffer.tag(offset) is Tag.PREPOSITION

    def _preposition(self, word: str) -> None:
        buffer = self._buffer
        text, bounds = split_bounds(word)
        relation = PREPOSITIONS[text]
        before, after = buffer.tag(-1), buffer.tag(1)
        if word == "of" and before is Tag.DETERMINER and not buffer.words:
            return
        if before is Tag.PARTICIPLE and not buffer.words and buffer.last_kind() is ChunkKind.STATEMENT:
            return  # "someone knocked over"
        directly = not buffer.words and buffer.last_kind() is ChunkKind.VERB and before is Tag.VERB
        elided = [chunk.kind for chunk in buffer.chunks[-3:-1]] == [ChunkKind.NOUN, ChunkKind.CONJUNCTION]
        # "rinse the plate and put in the rack"
        elided = elided and word == "in" and buffer.chunks[-1].word in verbs.PLACE_VERBS
        if directly and bounds is None and not elided and verbs.is_particle(buffer.chunks[-1].word, word):
            if relation in _ROUTE_RELATIONS and buffer.chunks[-1].word in verbs.GO_VERBS:
                buffer.emit_preposition("via", word)
            return
        is_finite = before is Tag.VERB and verbs.base_of_s(buffer.word(-1)) is not None  # "which door leads to"
        in_modifier = before is Tag.GERUND or buffer.tag(-2) is Tag.RELATIVE or is_finite
        buffer.close()
        if relation == "to" and buffer.last_kind() is ChunkKind.NOUN:
            if in_modifier:
                relation = "purpose"  # "the door that leads to the hall"
            elif before is Tag.PARTICIPLE and buffer.last_verb() not in WISHES:
                relation = "near"  # "the chair pushed into the desk"
        if after is Tag.PREPOSITION or (after is Tag.GERUND and word in ("for", "by", "before", "after")):
            buffer.close()
            return
        is_required = buffer.last_kind() is ChunkKind.SUBJECT_VERB  # "should be stacked against the wall"
        buffer.emit_preposition(relation, text, before in _LOCATION_TAGS and not is_required, bounds)
