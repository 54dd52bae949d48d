"""Chunk verbs, gerunds, participles and auxiliaries."""

from __future__ import annotations

from typing import Final

from gausslite.task import lexicon
from gausslite.task.chunk import ChunkKind
from gausslite.task.chunk_buffer import ChunkBuffer
from gausslite.task.clause_types import SUBJECT_TAGS, WISHES, is_command, is_modal
from gausslite.task.part_of_speech import Tag
from gausslite.task.verb_forms import verb_base
from gausslite.task.verbs import ASPECT_VERBS, BELONGING_VERBS, HOLDING_VERBS
from gausslite.task.word_set import word_set

_RELATIVES: Final = word_set("that which who whom")
_HAVE_FORMS: Final = word_set("has have had")
_BEFORE_GERUND_TAGS: Final = frozenset({Tag.NOUN, Tag.PREPOSITION, Tag.NEGATION, Tag.VERB, Tag.AUXILIARY})
_MODIFIED_TAGS: Final = frozenset({Tag.NOUN, Tag.PARTICIPLE})
NOUN_PHRASE_TAGS: Final = frozenset({Tag.NOUN, Tag.ADJECTIVE})
OBJECT_START_TAGS: Final = frozenset({Tag.DETERMINER, Tag.NOUN, Tag.ADJECTIVE, Tag.INDEFINITE})


class VerbChunker:
    """Handles the verb forms of a sentence; its subject and its modal verb decide what a verb means."""

    def __init__(self, buffer: ChunkBuffer) -> None:
        self._buffer = buffer
        self._after_modal = False
        self._relative_chunk: int | None = None

    def relative(self, word: str) -> None:
        """Remember where a relative clause starts."""
        self._buffer.close()
        if word in _RELATIVES and self._buffer.last_kind() is ChunkKind.NOUN:
            self._relative_chunk = len(self._buffer.chunks)

    def auxiliary(self, word: str) -> None:
        """Handle "is", "has" and the like; "has" with an object means near."""
        buffer = self._buffer
        self._end_relative_subject(finite=True)
        if word in _HAVE_FORMS and buffer.last_kind() is ChunkKind.NOUN and buffer.tag(1) in OBJECT_START_TAGS:
            buffer.emit_preposition("near")
        self._after_modal = is_modal(buffer.tagged, buffer.index) and buffer.last_kind() is ChunkKind.NOUN

    def verb(self, word: str) -> None:
        """Emit an instruction; a verb of a subordinate clause relates its object to its subject."""
        buffer = self._buffer
        self._end_relative_subject(finite=True)
        base = verb_base(word) or word
        if buffer.negates_next:
            self._negated_verb(base)
            return
        subject, tagged, index = buffer.tag(-1), buffer.tagged, buffer.index
        is_required = self._after_modal
        self._after_modal = is_modal(tagged, index) and subject in SUBJECT_TAGS
        is_wish = subject is Tag.PRONOUN and base in WISHES
        if subject is Tag.INFINITIVE and buffer.tag(-2) is Tag.INDEFINITE and buffer.tag(1) not in OBJECT_START_TAGS:
            buffer.close()  # "something to write with"
        elif is_required and self._subject_is_object():
            if base in BELONGING_VERBS:
                buffer.emit(ChunkKind.SUBJECT_VERB, base)
        elif subject not in SUBJECT_TAGS or is_wish or is_command(tagged, index):
            buffer.emit(ChunkKind.VERB, base)
        elif base in BELONGING_VERBS and subject is not Tag.PRONOUN:
            buffer.emit(ChunkKind.SUBJECT_VERB, base)
        elif subject in (Tag.NOUN, Tag.RELATIVE, Tag.INDEFINITE) and buffer.tag(1) in OBJECT_START_TAGS | {Tag.PRONOUN}:
            self._subordinate_verb(base)
        else:
            buffer.close()

    def gerund(self, word: str) -> None:
        """Handle an -ing form: an adjective, an instruction, or a relation of the noun before it."""
        buffer = self._buffer
        before, after = buffer.tag(-1), buffer.tag(1)
        if buffer.negates_next:
            self._negated_verb(verb_base(word) or word)
            return
        can_start = buffer.has_determiner or before not in _BEFORE_GERUND_TAGS
        can_start = can_start or (
            before is Tag.VERB and buffer.last_kind() is ChunkKind.VERB and buffer.chunks[-1].word not in ASPECT_VERBS
        )
        if can_start and after in NOUN_PHRASE_TAGS and lexicon.ADJECTIVES.issuperset(buffer.words):
            buffer.words.append(word)  # "the leaking pipe"
        elif before is Tag.PREPOSITION and buffer.last_kind() is ChunkKind.NOUN and buffer.tag(-2) in _MODIFIED_TAGS:
            buffer.close()  # "a cloth for wiping the table"
            if after in OBJECT_START_TAGS:
                buffer.emit_preposition("purpose")
        elif buffer.words or before in (Tag.NOUN, Tag.INDEFINITE, Tag.AUXILIARY, Tag.RELATIVE):
            self._gerund_after_noun(after)
        else:
            buffer.emit(ChunkKind.VERB, verb_base(word) or word, gerund=True)

    def participle(self, word: str) -> None:
        """Handle a participle: an adjective, a required state, or a modifier of the noun before it."""
        buffer = self._buffer
        before, after = buffer.tag(-1), buffer.tag(1)
        if after in NOUN_PHRASE_TAGS and before not in (Tag.NOUN, Tag.INDEFINITE, Tag.PRONOUN):
            buffer.words.append(word)
            return
        self._end_relative_subject(finite=after is Tag.PRONOUN)
        if self._after_modal and self._subject_is_object():
            buffer.emit(ChunkKind.SUBJECT_VERB, verb_base(word) or word)
        elif after in OBJECT_START_TAGS and buffer.last_kind() is ChunkKind.NOUN:
            buffer.chunks.pop()  # "the toy my son dropped": the son is irrelevant
        self._after_modal = False

    def _negated_verb(self, base: str) -> None:
        """Skip the verb of "that is not standing on"; "who does not wear a helmet" means not near it."""
        self._buffer.close()
        if base in HOLDING_VERBS:
            self._buffer.emit_preposition("near")

    def _end_relative_subject(self, finite: bool) -> None:
        """Remove the subject of a relative clause: the wife in "the mug (that) my wife uses"."""
        buffer = self._buffer
        buffer.close()
        adjacent = buffer.determiner_at > 0 and buffer.tagged[buffer.determiner_at - 1][1] is Tag.NOUN
        if finite and adjacent and [chunk.kind for chunk in buffer.chunks[-2:]] == [ChunkKind.NOUN, ChunkKind.NOUN]:
            buffer.chunks.pop()
        if self._relative_chunk is not None and self._relative_chunk == len(buffer.chunks) - 1:
            buffer.chunks.pop()
        self._relative_chunk = None

    def _subordinate_verb(self, base: str) -> None:
        """Handle the verb of a subordinate clause: "holds" in "the shelf that holds the cans" means near."""
        buffer = self._buffer
        if base in HOLDING_VERBS:
            buffer.emit_preposition("near")
        elif buffer.tag(-1) is Tag.INDEFINITE and buffer.last_kind() is ChunkKind.NOUN:
            buffer.chunks.pop()
        else:
            buffer.emit_preposition("purpose")

    def _subject_is_object(self) -> bool:
        noun = self._buffer.chunks[-1].noun if self._buffer.chunks else None
        return noun is not None and noun.head not in lexicon.ADDRESSEES

    def _gerund_after_noun(self, after: Tag | None) -> None:
        """Relate the object of the gerund: "the person holding a cup" is near the cup."""
        if after in OBJECT_START_TAGS:
            self._buffer.emit_preposition("near")
        else:
            self._buffer.close()
