"""Chunk a sentence into verbs, noun phrases, prepositions and conjunctions (shallow parsing)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

from gausslite.task import lexicon
from gausslite.task.chunk import Chunk, ChunkKind
from gausslite.task.clause_types import (
    SUBJECT_PRONOUNS,
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
# "go around the table to the sofa": the table is a waypoint, the sofa the goal
_ROUTE_RELATIONS: Final = word_set("near past above")
_HAVE_FORMS: Final = word_set("has have had")
_DO_FORMS: Final = word_set("do does did")
_NEGATED_VERBS: Final = WISHES | word_set("care touch mean")
_NOUN_PHRASE_TAGS: Final = frozenset({Tag.NOUN, Tag.ADJECTIVE})
# "the drawer open", "is empty"
_BEFORE_STATE_TAGS: Final = frozenset({Tag.NOUN, Tag.INDEFINITE, Tag.AUXILIARY})
_BEFORE_GERUND_TAGS: Final = frozenset({Tag.NOUN, Tag.PREPOSITION, Tag.NEGATION, Tag.VERB, Tag.AUXILIARY})
_MODIFIED_TAGS: Final = frozenset({Tag.NOUN, Tag.PARTICIPLE})
# tags before a preposition that states where something is, not where to put it
_LOCATION_TAGS: Final = frozenset({Tag.AUXILIARY, Tag.RELATIVE, Tag.PARTICIPLE, Tag.GERUND})
# "that is not a duck" excludes something, "that is not open" does not
_EXCLUDING_TAGS: Final = frozenset({Tag.VERB, Tag.DETERMINER, Tag.NOUN})
_OBJECT_START_TAGS: Final = frozenset({Tag.DETERMINER, Tag.NOUN, Tag.ADJECTIVE, Tag.INDEFINITE})


def chunk_sentence(text: str) -> list[Chunk]:
    """Return the chunks of one normalised sentence, in order."""
    return _Chunker(tag_words(lexical_units(text))).run()


class _Chunker:
    """Chunk tagged words in one pass; `_words` collects the words of the current noun phrase."""

    def __init__(self, tagged: Sequence[tuple[str, Tag]]) -> None:
        self._tagged = tagged
        self._clause_types = clause_types(tagged)
        self._index = 0
        self._chunks: list[Chunk] = []
        self._words: list[str] = []
        self._has_determiner = False
        self._superlative = False
        self._after_modal = False
        self._determiner_at = 0
        self._relative_chunk: int | None = None
        self._handlers: dict[Tag, Callable[[str], None]] = {
            Tag.NOUN: self._noun,
            Tag.ADJECTIVE: self._adjective,
            Tag.DETERMINER: self._determiner,
            Tag.VERB: self._verb,
            Tag.GERUND: self._gerund,
            Tag.PARTICIPLE: self._participle,
            Tag.PREPOSITION: self._preposition,
            Tag.PARTICLE: self._particle,
            Tag.CONJUNCTION: lambda word: self._emit(ChunkKind.CONJUNCTION, word),
            Tag.CLAUSE_BREAK: self._clause_break,
            Tag.INDEFINITE: self._indefinite,
            Tag.AUXILIARY: self._auxiliary,
            Tag.RELATIVE: self._relative,
            Tag.PRONOUN: self._pronoun,
            Tag.ANAPHOR: self._anaphor,
            Tag.NEGATION: self._negation,
        }

    def run(self) -> list[Chunk]:
        """Return the chunks of all words; clauses that give a reason are skipped."""
        clause = ClauseType.REQUEST
        for index, (word, tag) in enumerate(self._tagged):
            self._index = index
            previous, clause = clause, self._clause_types.get(index, clause)
            starts_request = previous is ClauseType.STATEMENT or self._starts_question(index)
            if tag is Tag.CONJUNCTION and clause is ClauseType.REQUEST and starts_request:
                tag = Tag.CLAUSE_BREAK
            if clause is ClauseType.STATEMENT and index in self._clause_types:
                self._emit(ChunkKind.STATEMENT, word)
                if tag in (Tag.CLAUSE_BREAK, Tag.CONJUNCTION):
                    continue
            if clause is not ClauseType.REASON:
                self._handlers.get(tag, self._skip)(word)
        self._close()
        return self._chunks

    def _starts_question(self, index: int) -> bool:
        """Return True for "if it is no trouble, could you come": the question starts a new sentence."""
        return index in self._clause_types and self._tag(1) is Tag.AUXILIARY

    def _tag(self, offset: int) -> Tag | None:
        position = self._index + offset
        return self._tagged[position][1] if 0 <= position < len(self._tagged) else None

    def _word(self, offset: int) -> str:
        position = self._index + offset
        return self._tagged[position][0] if 0 <= position < len(self._tagged) else ""

    def _last_kind(self) -> ChunkKind | None:
        return self._chunks[-1].kind if self._chunks else None

    def _emit(self, kind: ChunkKind, word: str, gerund: bool = False, current_place: bool = False) -> None:
        self._close()
        self._chunks.append(Chunk(kind, word, gerund=gerund, current_place=current_place))

    def _close(self) -> None:
        """End the current noun phrase."""
        if self._words:
            noun = noun_phrase(self._words, self._has_determiner, self._superlative)
            self._chunks.append(Chunk(ChunkKind.NOUN, self._words[-1], noun))
        self._words, self._has_determiner, self._superlative = [], False, False

    def _skip(self, _word: str) -> None:
        self._close()

    def _noun(self, word: str) -> None:
        # "the red and blue mugs": a lone adjective shares the noun of the next phrase
        if not self._words and self._last_kind() is ChunkKind.CONJUNCTION and len(self._chunks) >= 2:
            before = self._chunks[-2].noun
            if before is not None and adjectives_only(before.words):
                self._has_determiner = before.has_determiner
        self._words.append(word)

    def _adjective(self, word: str) -> None:
        if word.endswith(("'s", "s'")):
            self._determiner(word)
            self._words = []
        elif word in _SUPERLATIVES:
            self._superlative = True
        elif self._tag(-1) in _BEFORE_STATE_TAGS and self._tag(1) not in _NOUN_PHRASE_TAGS:
            self._close()
        else:
            self._words.append(word)

    def _determiner(self, word: str) -> None:
        if word.endswith(("'s", "s'")):
            self._words = []
        self._close()
        self._has_determiner, self._determiner_at = True, self._index

    def _indefinite(self, word: str) -> None:
        self._close()
        # "what does the sign say", "what is that thing"
        if word == "what" and (
            self._word(1) in _DO_FORMS or (self._tag(2) in _OBJECT_START_TAGS and self._tag(1) is Tag.AUXILIARY)
        ):
            return
        self._words.append(lexicon.INDEFINITE_PRONOUNS.get(word, "person"))
        self._close()

    def _anaphor(self, word: str) -> None:
        self._emit(ChunkKind.DEMONSTRATIVE if word in _DEMONSTRATIVES else ChunkKind.ANAPHOR, word)

    def _clause_break(self, word: str) -> None:
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
        """Negate the chunks before the verb: "the lamp and the vase must not be touched"."""
        self._close()
        first = len(self._chunks)
        while first and self._chunks[first - 1].kind in (ChunkKind.NOUN, ChunkKind.CONJUNCTION):
            first -= 1
        self._chunks.insert(first, Chunk(ChunkKind.NEGATION, word))

    def _pronoun(self, word: str) -> None:
        """Start a new clause at the pronoun of "ignore the cars, I only want the bikes"."""
        self._close()
        after_conjunction = self._last_kind() is ChunkKind.CONJUNCTION and self._index - 1 in self._clause_types
        if after_conjunction and word in SUBJECT_PRONOUNS:
            self._emit(ChunkKind.CLAUSE_BREAK, word)

    def _relative(self, word: str) -> None:
        self._close()
        if word in _RELATIVES and self._last_kind() is ChunkKind.NOUN:
            self._relative_chunk = len(self._chunks)

    def _end_relative_subject(self, finite: bool) -> None:
        """Remove the subject of a relative clause: the wife in "the mug (that) my wife uses"."""
        self._close()
        adjacent = self._determiner_at > 0 and self._tagged[self._determiner_at - 1][1] is Tag.NOUN
        if finite and adjacent and [chunk.kind for chunk in self._chunks[-2:]] == [ChunkKind.NOUN, ChunkKind.NOUN]:
            self._chunks.pop()
        if self._relative_chunk is not None and self._relative_chunk == len(self._chunks) - 1:
            self._chunks.pop()
        self._relative_chunk = None

    def _auxiliary(self, word: str) -> None:
        self._end_relative_subject(finite=True)
        if word in _HAVE_FORMS and self._last_kind() is ChunkKind.NOUN and self._tag(1) in _OBJECT_START_TAGS:
            self._emit(ChunkKind.PREPOSITION, "near")
        self._after_modal = is_modal(self._tagged, self._index) and self._last_kind() is ChunkKind.NOUN

    def _verb(self, word: str) -> None:
        self._end_relative_subject(finite=True)
        base = verb_base(word) or word
        subject = self._tag(-1)
        is_required = self._after_modal
        self._after_modal = is_modal(self._tagged, self._index) and subject in SUBJECT_TAGS
        is_wish = subject is Tag.PRONOUN and base in WISHES
        if subject is Tag.INFINITIVE and self._tag(-2) is Tag.INDEFINITE and self._tag(1) not in _OBJECT_START_TAGS:
            self._close()  # "something to write with"
        elif is_required and self._subject_is_object():
            if base in BELONGING_VERBS:
                self._emit(ChunkKind.SUBJECT_VERB, base)
        elif subject not in SUBJECT_TAGS or is_wish or is_command(self._tagged, self._index):
            self._emit(ChunkKind.VERB, base)
        elif base in BELONGING_VERBS and subject is not Tag.PRONOUN:
            self._emit(ChunkKind.SUBJECT_VERB, base)
        elif subject in (Tag.NOUN, Tag.RELATIVE, Tag.INDEFINITE) and self._tag(1) in _OBJECT_START_TAGS | {Tag.PRONOUN}:
            self._subordinate_verb(base)
        else:
            self._close()

    def _subordinate_verb(self, base: str) -> None:
        """Handle the verb of a subordinate clause: "holds" in "the shelf that holds the cans" means near."""
        if base in HOLDING_VERBS:
            self._emit(ChunkKind.PREPOSITION, "near")
        elif self._tag(-1) is Tag.INDEFINITE and self._last_kind() is ChunkKind.NOUN:
            self._chunks.pop()
        else:
            self._emit(ChunkKind.PREPOSITION, "purpose")

    def _subject_is_object(self) -> bool:
        noun = self._chunks[-1].noun if self._chunks else None
        return noun is not None and noun.head not in lexicon.ADDRESSEES

    def _gerund(self, word: str) -> None:
        before, after = self._tag(-1), self._tag(1)
        can_start = self._has_determiner or before not in _BEFORE_GERUND_TAGS
        can_start = can_start or (
            before is Tag.VERB and self._last_kind() is ChunkKind.VERB and self._chunks[-1].word not in ASPECT_VERBS
        )
        if can_start and after in _NOUN_PHRASE_TAGS and lexicon.ADJECTIVES.issuperset(self._words):
            self._words.append(word)  # "the leaking pipe"
        elif before is Tag.PREPOSITION and self._last_kind() is ChunkKind.NOUN and self._tag(-2) in _MODIFIED_TAGS:
            self._close()  # "a cloth for wiping the table"
            if after in _OBJECT_START_TAGS:
                self._emit(ChunkKind.PREPOSITION, "purpose")
        elif self._words or before in (Tag.NOUN, Tag.INDEFINITE, Tag.AUXILIARY, Tag.RELATIVE):
            self._gerund_after_noun(after)
        else:
            self._emit(ChunkKind.VERB, verb_base(word) or word, gerund=True)

    def _gerund_after_noun(self, after: Tag | None) -> None:
        """Relate the object of the gerund: "the person holding a cup" is near the cup."""
        if after in _OBJECT_START_TAGS:
            self._emit(ChunkKind.PREPOSITION, "near")
        else:
            self._close()

    def _participle(self, word: str) -> None:
        before, after = self._tag(-1), self._tag(1)
        if after in _NOUN_PHRASE_TAGS and before not in (Tag.NOUN, Tag.INDEFINITE, Tag.PRONOUN):
            self._words.append(word)
            return
        self._end_relative_subject(finite=after is Tag.PRONOUN)
        if self._after_modal and self._subject_is_object():
            self._emit(ChunkKind.SUBJECT_VERB, verb_base(word) or word)
        elif after in _OBJECT_START_TAGS and self._last_kind() is ChunkKind.NOUN:
            self._chunks.pop()  # "the toy my son dropped": the son is irrelevant
        self._after_modal = False

    def _preposition(self, word: str) -> None:
        relation = PREPOSITIONS[word]
        before, after = self._tag(-1), self._tag(1)
        if word == "of" and before is Tag.DETERMINER and not self._words:
            return
        directly = not self._words and self._last_kind() is ChunkKind.VERB and before is Tag.VERB
        if directly and is_particle(self._chunks[-1].word, word):
            if relation in _ROUTE_RELATIONS and self._chunks[-1].word in GO_VERBS:
                self._emit(ChunkKind.PREPOSITION, "via")
            return
        in_modifier = before is Tag.GERUND or self._tag(-2) is Tag.RELATIVE
        if relation == "to" and in_modifier and self._last_kind() is ChunkKind.NOUN:
            relation = "purpose"  # "the door that leads to the hall"
        if after is Tag.PREPOSITION or (after is Tag.GERUND and word in ("for", "by", "before", "after")):
            self._close()
            return
        self._emit(ChunkKind.PREPOSITION, relation, current_place=before in _LOCATION_TAGS)

    def _particle(self, word: str) -> None:
        self._close()
        if word in PREPOSITIONS and (self._tag(1), self._tag(2)) == (Tag.CONJUNCTION, Tag.PREPOSITION):
            self._emit(ChunkKind.PREPOSITION, PREPOSITIONS[word])  # "under or behind the couch"
