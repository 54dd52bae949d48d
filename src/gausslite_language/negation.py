"""Chunk negations: "not", "no" and "without" negate a relation or an attribute, exclude an object, or mean nothing."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

from gausslite_language import lexicon
from gausslite_language.chunk import Chunk, ChunkBuffer, ChunkKind
from gausslite_language.clause_types import INABILITIES, WISHES
from gausslite_language.lexicon import is_attribute, singular, word_set
from gausslite_language.nouns import is_thing
from gausslite_language.tags import Tag
from gausslite_language.verbs import HOLDING_VERBS, POSTURE_VERBS, TOOL_VERBS, verb_base

HAVE_FORMS: Final = word_set("has have had")
NOUN_PHRASE_TAGS: Final = frozenset({Tag.NOUN, Tag.ADJECTIVE})
OBJECT_START_TAGS: Final = frozenset({Tag.DETERMINER, Tag.NOUN, Tag.ADJECTIVE, Tag.INDEFINITE})
_FINDING_VERBS: Final = word_set("find see locate spot")
_NEGATED_VERBS: Final = WISHES | word_set("care touch mean")
# "that is not a duck" excludes something, "that is not open" does not
_EXCLUDING_TAGS: Final = frozenset({Tag.VERB, Tag.DETERMINER, Tag.NOUN})
_VERB_FORMS: Final = frozenset({Tag.VERB, Tag.GERUND, Tag.PARTICIPLE})
_NOUN_BEFORE: Final = frozenset({Tag.NOUN, Tag.INDEFINITE, Tag.RELATIVE, Tag.AUXILIARY, Tag.ANAPHOR, Tag.CONJUNCTION})
_SUBJECTS: Final = word_set("i we he she they one")
_NOTS: Final = word_set("not never") | {"but not", "do not", "doesn't", "don't", "dont"}
_CLAUSE_START_TAGS: Final = frozenset({None, Tag.CLAUSE_BREAK, Tag.CONJUNCTION})
_QUESTION_WORDS: Final = word_set("is are was were does did has have can could would will")


def chunk_negation(buffer: ChunkBuffer, word: str) -> None:
    """Handle the negation at the current word."""
    before, after = buffer.tag(-1), buffer.tag(1)
    if word == "no" or (word == "neither" and buffer.word(-1) in HAVE_FORMS):
        _deny(buffer)
    elif word == "nor" and _denies_place(buffer):
        buffer.negates_next = True
        buffer.emit_preposition("near", "without")
    elif before is Tag.PRONOUN and buffer.word(-1) in _SUBJECTS and verb_base(buffer.word(1)) not in _NEGATED_VERBS:
        buffer.close()  # "I can't find my phone"
        # "I can't find it on the sofa"
        found = verb_base(buffer.word(1)) in _FINDING_VERBS and buffer.tag(2) is Tag.ANAPHOR
        buffer.negates_next = found and buffer.tag(3) is Tag.PREPOSITION
    elif word in INABILITIES and before in (Tag.NOUN, Tag.INDEFINITE) and after is Tag.VERB:
        buffer.close()  # "my son can't find his bear"
        if buffer.last_kind() is ChunkKind.NOUN:
            buffer.chunks.pop()
    elif _opens_question(buffer) or (buffer.word(-1), buffer.word(1)) == ("if", ","):
        buffer.close()  # "isn't there a mug on the table?", "if not, wait for him"
    elif (word in _NOTS and _negates_place(buffer)) or (
        word in _NOTS and is_attribute(buffer.word(1)) and _follows_noun_of_state(buffer)
    ):
        buffer.close()
        buffer.negates_next = True
    elif word == "without" and _modifies_noun(buffer):
        buffer.close()
        buffer.negates_next = True
        buffer.emit_preposition("near", word)
    elif after is Tag.AUXILIARY and buffer.tag(2) in (Tag.PARTICIPLE, Tag.VERB):
        _exclude_subject(buffer, word)
    elif (
        before is Tag.AUXILIARY
        and word != "do not"
        and buffer.word(-1) != "do"
        and (after not in _EXCLUDING_TAGS or _is_state(buffer))
    ):
        buffer.emit(ChunkKind.NOT_UNDERSTOOD, f"{word} {buffer.word(1)}".strip())
    else:
        buffer.emit(ChunkKind.NEGATION, word)


def _denies_place(buffer: ChunkBuffer) -> bool:
    """Return True at the "nor" of "has neither a helmet nor a vest"."""
    buffer.close()
    return len(buffer.chunks) > 1 and buffer.chunks[-2].kind is ChunkKind.PREPOSITION and buffer.chunks[-2].negated


def _deny(buffer: ChunkBuffer) -> None:
    """Negate the relation of "with no lid", "has no lid", "with a lamp but no shade"; exclude for "no forks"."""
    buffer.close()
    kinds = [chunk.kind for chunk in buffer.chunks[-3:]]
    listed = kinds == [ChunkKind.PREPOSITION, ChunkKind.NOUN, ChunkKind.CONJUNCTION]
    wears = buffer.tag(-2) is Tag.RELATIVE and verb_base(buffer.word(-1)) in HOLDING_VERBS
    if kinds[-1:] == [ChunkKind.PREPOSITION]:
        buffer.chunks[-1] = replace(buffer.chunks[-1], negated=True)
    elif ((wears or buffer.word(-1) in HAVE_FORMS) and kinds[-1:] == [ChunkKind.NOUN]) or (
        listed and buffer.chunks[-3].word in ("with", "near")
    ):
        buffer.negates_next = True
        buffer.emit_preposition("near", "without")
    elif buffer.tag(-1) is not Tag.AUXILIARY:
        buffer.emit(ChunkKind.NEGATION, "no")


def _follows_noun_of_state(buffer: ChunkBuffer) -> bool:
    """Return True for the "not" of "the mug that is not red" and "anything not red"."""
    is_relative = buffer.tag(-1) is Tag.AUXILIARY and buffer.tag(-2) is Tag.RELATIVE
    is_bare = buffer.tag(-1) is Tag.INDEFINITE and buffer.tag(2) not in NOUN_PHRASE_TAGS
    return is_relative or is_bare


def _is_state(buffer: ChunkBuffer) -> bool:
    """Return True for an unknown word in "that is not rotten", unlike "that are not chairs"."""
    word = buffer.word(1)
    return buffer.tag(1) is Tag.NOUN and word not in lexicon.NOUNS and singular(word) == word and not is_thing(word)


def _opens_question(buffer: ChunkBuffer) -> bool:
    is_question = buffer.word(-1) in _QUESTION_WORDS and buffer.tag(-2) in _CLAUSE_START_TAGS
    return is_question and buffer.tag(1) in OBJECT_START_TAGS | {Tag.ANAPHOR}


def _negates_place(buffer: ChunkBuffer) -> bool:
    """Return True for "(that is) not on", "(that do) not hang on", "(who is) not wearing"."""
    if buffer.tag(-1) not in _NOUN_BEFORE or not (buffer.words or buffer.chunks):
        return False
    if buffer.tag(1) is Tag.PREPOSITION:
        return True
    base, after = verb_base(buffer.word(1)), buffer.tag(2)
    if buffer.tag(-1) is Tag.AUXILIARY and buffer.word(1) in HAVE_FORMS and after in OBJECT_START_TAGS:
        return True
    if buffer.tag(-1) is Tag.NOUN and buffer.tag(1) is Tag.PARTICIPLE:
        return after is Tag.PREPOSITION  # "the chair not tucked under the table"
    in_clause = buffer.tag(-1) in (Tag.AUXILIARY, Tag.RELATIVE) and buffer.tag(1) in _VERB_FORMS
    is_place = (base in POSTURE_VERBS or buffer.tag(1) is Tag.PARTICIPLE) and after is Tag.PREPOSITION
    return in_clause and (is_place or (base in HOLDING_VERBS and after in OBJECT_START_TAGS))


def _modifies_noun(buffer: ChunkBuffer) -> bool:
    """Return True for "the worker without a helmet", not for "wipe the table without the sponge"."""
    is_noun = buffer.tag(-1) in (Tag.NOUN, Tag.INDEFINITE) and buffer.tag(1) in OBJECT_START_TAGS
    has_action = buffer.last_verb() in TOOL_VERBS
    part = buffer.word(1) if buffer.tag(1) is not Tag.DETERMINER else buffer.word(2)
    return is_noun and (not has_action or part in lexicon.PARTS)


def _exclude_subject(buffer: ChunkBuffer, word: str) -> None:
    """Negate the chunks before the verb: "the lamp and the vase must not be touched"."""
    buffer.close()
    first = len(buffer.chunks)
    while first and buffer.chunks[first - 1].kind in (ChunkKind.NOUN, ChunkKind.CONJUNCTION):
        first -= 1
    base = verb_base(buffer.word(2)) or buffer.word(2)
    buffer.chunks[first:first] = [Chunk(ChunkKind.NEGATION, word), Chunk(ChunkKind.VERB, base, gerund=True)]
