"""Find the clauses of a tag_words sentence, and which of them ask for something, state something or give a reason."""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum
from typing import Final

from gausslite.task.part_of_speech import Tag
from gausslite.task.verb_forms import verb_base
from gausslite.task.verbs import BELONGING_VERBS
from gausslite.task.word_set import word_set

TaggedWords = Sequence[tuple[str, Tag]]

NOMINATIVES: Final = word_set("i you we he she they")
MODALS: Final = word_set("must should ought")
SEMI_MODALS: Final = word_set("has have had need needs")
WISHES: Final = word_set("need want like love require prefer seek")
SUBJECT_TAGS: Final = frozenset({Tag.NOUN, Tag.INDEFINITE, Tag.PRONOUN, Tag.RELATIVE, Tag.ANAPHOR})
_LOST_STATES: Final = word_set("missing lost gone")
_OTHER_PEOPLE: Final = word_set("i he she they")
_REASONS: Final = word_set("because since as although though")
_CONDITIONS: Final = word_set("if whether when once until unless before after while")
_TIMES: Final = word_set("when once until before after while")
_STRONG_CONJUNCTIONS: Final = word_set(", but +")
_PREDICATES: Final = frozenset({Tag.VERB, Tag.AUXILIARY, Tag.PARTICIPLE})
_QUESTION_OPENERS: Final = frozenset({Tag.AUXILIARY, Tag.INDEFINITE, Tag.RELATIVE})
_SUBJECT_TAGS: Final = frozenset({Tag.DETERMINER, Tag.ADJECTIVE, Tag.NOUN, Tag.PREPOSITION, Tag.INDEFINITE})


class ClauseType(Enum):
    """What a clause is for; an aside names nothing that is to be done unless a later clause points back at it."""

    REQUEST = "request"
    STATEMENT = "statement"
    REASON = "reason"


def clause_types(said: TaggedWords) -> dict[int, ClauseType]:
    """The first index of each clause, and its mood."""
    types: dict[int, ClauseType] = {}
    before = ClauseType.STATEMENT
    starts = [0, *(at for at in range(1, len(said)) if _begins_clause(said, at))]
    for start, end in zip(starts, [*starts[1:], len(said)], strict=True):
        before = types[start] = _clause_type(said, start, end, before)
    return types


def is_command(said: TaggedWords, at: int) -> bool:
    """True where the verb at this index is to be done: "bring", "could you bring", not "the cups belong", "I think".

    In "find the cup bring it here" the form tells: no single cup "bring".
    """
    word, subject_at = said[at][0], at - 1
    while subject_at >= 0 and said[subject_at][1] in (Tag.NEGATION, Tag.AUXILIARY):
        subject_at -= 1
    before, subject = said[subject_at] if subject_at >= 0 else ("", None)
    if subject is Tag.PRONOUN:
        related = subject_at > 0 and said[subject_at - 1][1] is Tag.RELATIVE
        return before not in _OTHER_PEOPLE and not related
    if subject not in SUBJECT_TAGS or subject_at < at - 1:
        return True
    if subject is Tag.RELATIVE or verb_base(word) != word or _is_question_subject(said, subject_at):
        return False
    return subject is not Tag.NOUN or not (before.endswith("s") or verb_base(word) in BELONGING_VERBS)


def _is_question_subject(said: TaggedWords, subject_at: int) -> bool:
    """True for the shelf in "does the shelf hold"."""
    while subject_at > 0 and said[subject_at][1] in _SUBJECT_TAGS:
        subject_at -= 1
    return said[subject_at][1] is Tag.AUXILIARY


def _begins_clause(said: TaggedWords, at: int) -> bool:
    tag = said[at][1]
    return tag is Tag.CLAUSE_BREAK or (tag is Tag.CONJUNCTION and _opens_clause(said, at))


def _opens_clause(said: TaggedWords, join: int) -> bool:
    """Behind a joint: a verb, or a subject with its verb."""
    tags = [tag for _, tag in said[join + 1 : join + 3]] + [None, None]
    if tags[0] in (Tag.VERB, Tag.NEGATION, Tag.AUXILIARY):
        return True
    if tags[0] in (Tag.PRONOUN, Tag.ANAPHOR):
        return tags[1] in _PREDICATES
    return said[join][0] in _STRONG_CONJUNCTIONS and _is_statement(said, join + 1)


def _is_statement(said: TaggedWords, start: int) -> bool:
    """True for a subject and what it does: "the sun is strong", "my son dropped his toy"."""
    for at in range(start, len(said)):
        tag = said[at][1]
        if tag in (Tag.AUXILIARY, Tag.VERB):
            return at > start and not (tag is Tag.VERB and is_command(said, at))
        if tag is Tag.PARTICIPLE and at + 1 < len(said) and said[at + 1][1] is Tag.DETERMINER:
            return at > start
        if tag not in _SUBJECT_TAGS and tag is not Tag.PARTICIPLE:
            return False
    return False


def _clause_type(said: TaggedWords, start: int, end: int, before: ClauseType) -> ClauseType:
    if start == end:
        return before
    opener, first = said[start], start
    while first < end and said[first][1] in (Tag.CLAUSE_BREAK, Tag.CONJUNCTION):
        first += 1
    clause = said[first:end]
    if opener[1] is Tag.CLAUSE_BREAK and opener[0] in _REASONS:
        return ClauseType.REASON
    if clause and opener[0] in _TIMES and clause[0][0] in _OTHER_PEOPLE | {"we"}:
        return ClauseType.STATEMENT  # "while I hold the door"
    if not clause or (opener[1] is Tag.CLAUSE_BREAK and opener[0] in _CONDITIONS):
        return ClauseType.REQUEST
    if (
        any(_is_request(said, at) for at in range(first, end))
        or clause[0][1] in _QUESTION_OPENERS
        or clause[0][0] == "which"
    ):
        return ClauseType.REQUEST
    # "bring the hammer. And the nails."
    elliptic = not any(tag in (Tag.AUXILIARY, Tag.VERB, Tag.PRONOUN) for _, tag in clause)
    return before if elliptic and before is ClauseType.REQUEST else ClauseType.STATEMENT


def is_modal(said: TaggedWords, at: int) -> bool:
    """True for "must", and for "has" in "has to go", "needs" in "needs to be moved" or "needs cleaning"."""
    after = said[at + 1][1] if at + 1 < len(said) else None
    return said[at][0] in MODALS or (said[at][0] in SEMI_MODALS and after in (Tag.INFINITIVE, Tag.GERUND))


def _is_request(said: TaggedWords, at: int) -> bool:
    """A command, a wish, or what has to become of a thing."""
    word, tag = said[at]
    before = said[at - 1][1] if at else None
    if tag is Tag.NEGATION:
        return before is not Tag.PRONOUN
    if tag is Tag.GERUND:
        return before not in SUBJECT_TAGS and before is not Tag.AUXILIARY and before is not Tag.DETERMINER
    if word in _LOST_STATES and before is Tag.AUXILIARY:
        return True
    if is_modal(said, at) and before in SUBJECT_TAGS and before is not Tag.PRONOUN:
        return True
    if tag is not Tag.VERB:
        return False
    base = verb_base(word)
    return is_command(said, at) or base in BELONGING_VERBS or base in WISHES
