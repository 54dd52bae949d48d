"""Read a sentence as a row of verbs, noun phrases, prepositions and joints, without yet asking what they mean."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

from gausslite.task import lexicon
from gausslite.task.chunk import Chunk, ChunkKind
from gausslite.task.clause_types import (
    NOMINATIVES,
    SUBJECT_TAGS,
    WISHES,
    ClauseType,
    clause_types,
    is_command,
    is_modal,
)
from gausslite.task.noun_phrase import adjectives_only, noun_phrase
from gausslite.task.part_of_speech import Tag
from gausslite.task.prepositions import PREPOSITIONS
from gausslite.task.tag_candidates import tag_words
from gausslite.task.tokenizer import lexical_units
from gausslite.task.verb_forms import is_particle, verb_base
from gausslite.task.verbs import ASPECT_VERBS, BELONGING_VERBS, GO_VERBS, HOLDING_VERBS
from gausslite.task.word_set import word_set

_DEMONSTRATIVES: Final = word_set("this that these those")
_SUPERLATIVES: Final = word_set("closest nearest")
_RELATIVES: Final = word_set("that which who whom")
# "go around the table to the sofa" passes the one and reaches the other
_ROUTE_RELATIONS: Final = word_set("near past above")
_HAVE_FORMS: Final = word_set("has have had")
_DO_FORMS: Final = word_set("do does did")
_NEGATED_VERBS: Final = WISHES | word_set("care touch mean")
_NOUN_PHRASE_TAGS: Final = frozenset({Tag.NOUN, Tag.ADJECTIVE})
# "the drawer open", "is empty"
_BEFORE_STATE_TAGS: Final = frozenset({Tag.NOUN, Tag.INDEFINITE, Tag.AUXILIARY})
_BEFORE_GERUND_TAGS: Final = frozenset({Tag.NOUN, Tag.PREPOSITION, Tag.NEGATION, Tag.VERB, Tag.AUXILIARY})
_MODIFIED_TAGS: Final = frozenset({Tag.NOUN, Tag.PARTICIPLE})
# what stands before a place where something is, and not where it is to go
_LOCATION_TAGS: Final = frozenset({Tag.AUXILIARY, Tag.RELATIVE, Tag.PARTICIPLE, Tag.GERUND})
# "that is not open" forbids nothing, "that is not a duck" does
_EXCLUDING_TAGS: Final = frozenset({Tag.VERB, Tag.DETERMINER, Tag.NOUN})
_OBJECT_START_TAGS: Final = frozenset({Tag.DETERMINER, Tag.NOUN, Tag.ADJECTIVE, Tag.INDEFINITE})


def read(text: str) -> list[Chunk]:
    """The chunks of one normalised sentence, in order."""
    return _Chunker(tag_words(lexical_units(text))).read()


class _Chunker:
    """Walks the tag_words words once, collecting the words of the noun phrase that is open."""

    def __init__(self, said: Sequence[tuple[str, Tag]]) -> None:
        self._tagged = said
        self.types = clause_types(said)
        self.at = 0
        self.chunks: list[Chunk] = []
        self.words: list[str] = []
        self.has_determiner = False
        self.superlative = False
        self.modal = False
        self.subject_at = 0
        self.relative_from: int | None = None
        self._read: dict[Tag, Callable[[str], None]] = {
            Tag.NOUN: self._noun,
            Tag.ADJECTIVE: self._adjective,
            Tag.DETERMINER: self._determiner,
            Tag.VERB: self._verb,
            Tag.GERUND: self._ing,
            Tag.PARTICIPLE: self._participle,
            Tag.PREPOSITION: self._preposition,
            Tag.PARTICLE: self._particle,
            Tag.CONJUNCTION: lambda word: self._emit(ChunkKind.CONJUNCTION, word),
            Tag.CLAUSE_BREAK: self._break,
            Tag.INDEFINITE: self._stand_in,
            Tag.AUXILIARY: self._auxiliary,
            Tag.RELATIVE: self._relative,
            Tag.PRONOUN: self._pronoun,
            Tag.ANAPHOR: self._back_reference,
            Tag.NEGATION: self._negation,
        }

    def read(self) -> list[Chunk]:
        mood = ClauseType.REQUEST
        for at, (word, tag) in enumerate(self._tagged):
            self.at = at
            before, mood = mood, self.types.get(at, mood)
            if (
                tag is Tag.CONJUNCTION
                and mood is ClauseType.REQUEST
                and (before is ClauseType.STATEMENT or self._starts_question(at))
            ):
                tag = Tag.CLAUSE_BREAK
            if mood is ClauseType.STATEMENT and at in self.types:
                self._emit(ChunkKind.STATEMENT, word)
                if tag in (Tag.CLAUSE_BREAK, Tag.CONJUNCTION):
                    continue
            if mood is not ClauseType.REASON:
                self._read.get(tag, self._skip)(word)
        self._close()
        return self.chunks

    def _starts_question(self, at: int) -> bool:
        """In "if it is no trouble, could you come" the question begins a sentence of its own."""
        return at in self.types and self._tag(1) is Tag.AUXILIARY

    def _tag(self, ahead: int) -> Tag | None:
        position = self.at + ahead
        return self._tagged[position][1] if 0 <= position < len(self._tagged) else None

    def _word(self, ahead: int) -> str:
        position = self.at + ahead
        return self._tagged[position][0] if 0 <= position < len(self._tagged) else ""

    def _last(self) -> ChunkKind | None:
        return self.chunks[-1].kind if self.chunks else None

    def _emit(self, kind: ChunkKind, word: str, gerund: bool = False, current_place: bool = False) -> None:
        self._close()
        self.chunks.append(Chunk(kind, word, gerund=gerund, current_place=current_place))

    def _close(self) -> None:
        """End the open noun phrase."""
        if self.words:
            self.chunks.append(
                Chunk(ChunkKind.NOUN, self.words[-1], noun_phrase(self.words, self.has_determiner, self.superlative))
            )
        self.words, self.has_determiner, self.superlative = [], False, False

    def _skip(self, _word: str) -> None:
        self._close()

    def _noun(self, word: str) -> None:
        # "the red and blue mugs": an adjective on its own waits for the noun of the next phrase
        if not self.words and self._last() is ChunkKind.CONJUNCTION and len(self.chunks) >= 2:
            before = self.chunks[-2].noun
            if before is not None and adjectives_only(before.words):
                self.has_determiner = before.has_determiner
        self.words.append(word)

    def _adjective(self, word: str) -> None:
        if word.endswith(("'s", "s'")):
            self._determiner(word)
            self.words = []
        elif word in _SUPERLATIVES:
            self.superlative = True
        elif self._tag(-1) in _BEFORE_STATE_TAGS and self._tag(1) not in _NOUN_PHRASE_TAGS:
            self._close()
        else:
            self.words.append(word)

    def _determiner(self, word: str) -> None:
        if word.endswith(("'s", "s'")):
            self.words = []
        self._close()
        self.has_determiner, self.subject_at = True, self.at

    def _stand_in(self, word: str) -> None:
        self._close()
        # "what does the sign say", "what is that thing"
        if word == "what" and (
            self._word(1) in _DO_FORMS or (self._tag(2) in _OBJECT_START_TAGS and self._tag(1) is Tag.AUXILIARY)
        ):
            return
        self.words.append(lexicon.INDEFINITE_PRONOUNS.get(word, "person"))
        self._close()

    def _back_reference(self, word: str) -> None:
        self._emit(ChunkKind.DEMONSTRATIVE if word in _DEMONSTRATIVES else ChunkKind.ANAPHOR, word)

    def _break(self, word: str) -> None:
        self._close()
        if word != "that":
            self._emit(ChunkKind.CLAUSE_BREAK, word)

    def _negation(self, word: str) -> None:
        if self._tag(-1) is Tag.PRONOUN and self._word(-1) != "you" and verb_base(self._word(1)) not in _NEGATED_VERBS:
            self._close()  # "I can't find my phone"
            return
        if self._tag(1) is Tag.AUXILIARY and self._tag(2) in (Tag.PARTICIPLE, Tag.VERB):
            self._exclude_subject(word)
            return
        if self._tag(-1) is Tag.AUXILIARY and self._word(-1) != "do" and self._tag(1) not in _EXCLUDING_TAGS:
            self._close()
        else:
            self._emit(ChunkKind.NEGATION, word)

    def _exclude_subject(self, word: str) -> None:
        """In "the lamp and the vase must not be touched" what is excluded stands before."""
        self._close()
        at = len(self.chunks)
        while at and self.chunks[at - 1].kind in (ChunkKind.NOUN, ChunkKind.CONJUNCTION):
            at -= 1
        self.chunks.insert(at, Chunk(ChunkKind.NEGATION, word))

    def _pronoun(self, word: str) -> None:
        """In "ignore the cars, I only want the bikes" a new sentence begins."""
        self._close()
        if word in NOMINATIVES and self._last() is ChunkKind.CONJUNCTION and self.at - 1 in self.types:
            self._emit(ChunkKind.CLAUSE_BREAK, word)

    def _relative(self, word: str) -> None:
        self._close()
        if word in _RELATIVES and self._last() is ChunkKind.NOUN:
            self.relative_from = len(self.chunks)

    def _end_relative_subject(self, finite: bool) -> None:
        """In "the mug that my wife uses" and "the mug my wife uses" the wife is none of the task's business."""
        self._close()
        adjacent = self.subject_at > 0 and self._tagged[self.subject_at - 1][1] is Tag.NOUN
        if finite and adjacent and [chunk.kind for chunk in self.chunks[-2:]] == [ChunkKind.NOUN, ChunkKind.NOUN]:
            self.chunks.pop()
        if self.relative_from is not None and self.relative_from == len(self.chunks) - 1:
            self.chunks.pop()
        self.relative_from = None

    def _auxiliary(self, word: str) -> None:
        self._end_relative_subject(finite=True)
        if word in _HAVE_FORMS and self._last() is ChunkKind.NOUN and self._tag(1) in _OBJECT_START_TAGS:
            self._emit(ChunkKind.PREPOSITION, "near")
        self.modal = is_modal(self._tagged, self.at) and self._last() is ChunkKind.NOUN

    def _verb(self, word: str) -> None:
        self._end_relative_subject(finite=True)
        base = verb_base(word) or word
        subject = self._tag(-1)
        self.modal, must = is_modal(self._tagged, self.at) and subject in SUBJECT_TAGS, self.modal
        if subject is Tag.INFINITIVE and self._tag(-2) is Tag.INDEFINITE and self._tag(1) not in _OBJECT_START_TAGS:
            self._close()  # "something to write with"
        elif must and self._subject_is_object():
            if base in BELONGING_VERBS:
                self._emit(ChunkKind.SUBJECT_VERB, base)
        elif (
            subject not in SUBJECT_TAGS
            or is_command(self._tagged, self.at)
            or (subject is Tag.PRONOUN and base in WISHES)
        ):
            self._emit(ChunkKind.VERB, base)
        elif base in BELONGING_VERBS and subject is not Tag.PRONOUN:
            self._emit(ChunkKind.SUBJECT_VERB, base)
        elif subject in (Tag.NOUN, Tag.RELATIVE, Tag.INDEFINITE) and self._tag(1) in _OBJECT_START_TAGS | {Tag.PRONOUN}:
            self._subordinate_verb(base)
        else:
            self._close()

    def _subordinate_verb(self, base: str) -> None:
        """The cans are near the shelf that holds them; who left a bag, and what a key opens, are not asked for."""
        if base in HOLDING_VERBS:
            self._emit(ChunkKind.PREPOSITION, "near")
        elif self._tag(-1) is Tag.INDEFINITE and self._last() is ChunkKind.NOUN:
            self.chunks.pop()
        else:
            self._emit(ChunkKind.PREPOSITION, "purpose")

    def _subject_is_object(self) -> bool:
        noun = self.chunks[-1].noun if self.chunks else None
        return noun is not None and noun.head not in lexicon.ADDRESSEES

    def _ing(self, word: str) -> None:
        before, after = self._tag(-1), self._tag(1)
        opens = self.has_determiner or before not in _BEFORE_GERUND_TAGS
        opens = opens or (
            before is Tag.VERB and self._last() is ChunkKind.VERB and self.chunks[-1].word not in ASPECT_VERBS
        )
        if opens and after in _NOUN_PHRASE_TAGS and lexicon.ADJECTIVES.issuperset(self.words):
            self.words.append(word)  # "the leaking pipe"
        elif before is Tag.PREPOSITION and self._last() is ChunkKind.NOUN and self._tag(-2) in _MODIFIED_TAGS:
            self._close()  # "a cloth for wiping the table"
            if after in _OBJECT_START_TAGS:
                self._emit(ChunkKind.PREPOSITION, "purpose")
        elif self.words or before in (Tag.NOUN, Tag.INDEFINITE, Tag.AUXILIARY, Tag.RELATIVE):
            self._gerund_after_noun(after)
        else:
            self._emit(ChunkKind.VERB, verb_base(word) or word, gerund=True)

    def _gerund_after_noun(self, after: Tag | None) -> None:
        """In "the person holding a cup" the cup is beside the person; in "the cat sleeping here" nothing is."""
        if after in _OBJECT_START_TAGS:
            self._emit(ChunkKind.PREPOSITION, "near")
        else:
            self._close()

    def _participle(self, word: str) -> None:
        before, after = self._tag(-1), self._tag(1)
        if after in _NOUN_PHRASE_TAGS and before not in (Tag.NOUN, Tag.INDEFINITE, Tag.PRONOUN):
            self.words.append(word)
            return
        self._end_relative_subject(finite=after is Tag.PRONOUN)
        if self.modal and self._subject_is_object():
            self._emit(ChunkKind.SUBJECT_VERB, verb_base(word) or word)
        elif after in _OBJECT_START_TAGS and self._last() is ChunkKind.NOUN:
            self.chunks.pop()  # who dropped it is none of the task's business
        self.modal = False

    def _preposition(self, word: str) -> None:
        relation = PREPOSITIONS[word]
        before, after = self._tag(-1), self._tag(1)
        if word == "of" and before is Tag.DETERMINER and not self.words:
            return
        directly = not self.words and self._last() is ChunkKind.VERB and before is Tag.VERB
        if directly and is_particle(self.chunks[-1].word, word):
            if relation in _ROUTE_RELATIONS and self.chunks[-1].word in GO_VERBS:
                self._emit(ChunkKind.PREPOSITION, "via")
            return
        if (
            relation == "to"
            and self._last() is ChunkKind.NOUN
            and (before is Tag.GERUND or self._tag(-2) is Tag.RELATIVE)
        ):
            relation = "purpose"  # "the door that leads to the hall"
        if after is Tag.PREPOSITION or (after is Tag.GERUND and word in ("for", "by", "before", "after")):
            self._close()
            return
        self._emit(ChunkKind.PREPOSITION, relation, current_place=before in _LOCATION_TAGS)

    def _particle(self, word: str) -> None:
        self._close()
        if word in PREPOSITIONS and (self._tag(1), self._tag(2)) == (Tag.CONJUNCTION, Tag.PREPOSITION):
            self._emit(ChunkKind.PREPOSITION, PREPOSITIONS[word])  # "under or behind the couch"
