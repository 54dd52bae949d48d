"""Chunk a sentence into verbs, noun phrases, prepositions and conjunctions (shallow parsing)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

from gausslite.task import lexicon
from gausslite.task.attributes import ORDINALS, is_attribute
from gausslite.task.chunk import Chunk, ChunkKind
from gausslite.task.chunk_buffer import ChunkBuffer
from gausslite.task.clause_types import SUBJECT_PRONOUNS, ClauseType, clause_types
from gausslite.task.negation_chunks import chunk_negation
from gausslite.task.noun_phrase import adjectives_only
from gausslite.task.part_of_speech import Tag
from gausslite.task.prepositions import PREPOSITIONS
from gausslite.task.tag_candidates import tag_words
from gausslite.task.tokenizer import lexical_units, split_bounds
from gausslite.task.verb_chunks import NOUN_PHRASE_TAGS, OBJECT_START_TAGS, VerbChunker
from gausslite.task.verb_forms import is_particle
from gausslite.task.verbs import GO_VERBS
from gausslite.task.word_set import word_set

_DEMONSTRATIVES: Final = word_set("this that these those")
# "go around the table to the sofa": the table is a waypoint, the sofa the goal
_ROUTE_RELATIONS: Final = word_set("near past above")
_DO_FORMS: Final = word_set("do does did")
# "the drawer open", "is empty"
_BEFORE_STATE_TAGS: Final = frozenset({Tag.NOUN, Tag.INDEFINITE, Tag.AUXILIARY})
# tags before a preposition that states where something is, not where to put it
_LOCATION_TAGS: Final = frozenset({Tag.AUXILIARY, Tag.RELATIVE, Tag.PARTICIPLE, Tag.GERUND, Tag.NEGATION})
_OBSERVERS: Final = word_set("me you us")
_THEY: Final = word_set("they he she")


def chunk_sentence(text: str) -> list[Chunk]:
    """Return the chunks of one normalised sentence, in order."""
    return _Chunker(tag_words(lexical_units(text))).run()


class _Chunker:
    """Chunk tagged words in one pass."""

    def __init__(self, tagged: Sequence[tuple[str, Tag]]) -> None:
        self._buffer = ChunkBuffer(tagged)
        self._verbs = VerbChunker(self._buffer)
        self._clause_types = clause_types(tagged)
        self._handlers: dict[Tag, Callable[[str], None]] = {
            Tag.NOUN: self._noun,
            Tag.ADJECTIVE: self._adjective,
            Tag.DETERMINER: self._determiner,
            Tag.VERB: self._verbs.verb,
            Tag.GERUND: self._verbs.gerund,
            Tag.PARTICIPLE: self._verbs.participle,
            Tag.PREPOSITION: self._preposition,
            Tag.PARTICLE: self._particle,
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
        if buffer.tag(-1) is Tag.NEGATION and buffer.last_kind() is ChunkKind.NOT_UNDERSTOOD:
            return  # "that is not rotten"
        # "the red and blue mugs": a lone adjective shares the noun of the next phrase
        if not buffer.words and buffer.last_kind() is ChunkKind.CONJUNCTION and len(buffer.chunks) >= 2:
            before = buffer.chunks[-2].noun
            if before is not None and adjectives_only(before.words):
                buffer.has_determiner = before.has_determiner
        buffer.words.append(word)

    def _adjective(self, word: str) -> None:
        buffer = self._buffer
        if word.endswith(("'s", "s'")):
            self._determiner(word)
            buffer.words = []
        elif buffer.tag(-1) is Tag.NEGATION and not buffer.negates_next and buffer.tag(1) not in NOUN_PHRASE_TAGS:
            buffer.close()  # "that is not broken"
        elif buffer.tag(-1) in _BEFORE_STATE_TAGS and buffer.tag(1) not in NOUN_PHRASE_TAGS:
            buffer.close()
            self._state(word)
        elif buffer.negates_next:
            self._state(word)
        else:
            buffer.words.append(word)

    def _state(self, word: str) -> None:
        """Emit the colour of "the mug that is red" or "anything red"; other states describe no object ("is empty")."""
        buffer = self._buffer
        before = (buffer.tag(-1), buffer.tag(-2))
        follows_noun = Tag.INDEFINITE in before or Tag.RELATIVE in (buffer.tag(-2), buffer.tag(-3))
        if follows_noun and buffer.last_kind() is ChunkKind.NOUN and is_attribute(word):
            buffer.chunks.append(Chunk(ChunkKind.ATTRIBUTE, word, negated=buffer.negates_next))
        buffer.negates_next = False

    def _determiner(self, word: str) -> None:
        buffer = self._buffer
        if word.endswith(("'s", "s'")):
            buffer.words = []
        buffer.close()
        buffer.has_determiner, buffer.determiner_at = True, buffer.index
        if word in ORDINALS and buffer.tag(1) in NOUN_PHRASE_TAGS:
            buffer.words.append(word)

    def _indefinite(self, word: str) -> None:
        buffer = self._buffer
        buffer.close()
        # "what does the sign say", "what is that thing"
        if word == "what" and (
            buffer.word(1) in _DO_FORMS or (buffer.tag(2) in OBJECT_START_TAGS and buffer.tag(1) is Tag.AUXILIARY)
        ):
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
        directly = not buffer.words and buffer.last_kind() is ChunkKind.VERB and before is Tag.VERB
        if directly and bounds is None and is_particle(buffer.chunks[-1].word, word):
            if relation in _ROUTE_RELATIONS and buffer.chunks[-1].word in GO_VERBS:
                buffer.emit_preposition("via", word)
            return
        in_modifier = before is Tag.GERUND or buffer.tag(-2) is Tag.RELATIVE
        if relation == "to" and in_modifier and buffer.last_kind() is ChunkKind.NOUN:
            relation = "purpose"  # "the door that leads to the hall"
        if after is Tag.PREPOSITION or (after is Tag.GERUND and word in ("for", "by", "before", "after")):
            buffer.close()
            return
        buffer.emit_preposition(relation, text, before in _LOCATION_TAGS, bounds)

    def _particle(self, word: str) -> None:
        buffer = self._buffer
        buffer.close()
        if word in PREPOSITIONS and (buffer.tag(1), buffer.tag(2)) == (Tag.CONJUNCTION, Tag.PREPOSITION):
            buffer.emit_preposition(PREPOSITIONS[word], word)  # "under or behind the couch"
