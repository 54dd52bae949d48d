"""Split a tagged sentence into clauses, and classify each as a request, a statement or a reason."""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum
from typing import Final

from gausslite_language.lexicon import word_set
from gausslite_language.tags import Tag
from gausslite_language.verbs import BELONGING_VERBS, verb_base

TaggedWords = Sequence[tuple[str, Tag]]

SUBJECT_PRONOUNS: Final = word_set("i you we he she they")
MODALS: Final = word_set("must should ought")
SEMI_MODALS: Final = word_set("has have had need needs")
WISHES: Final = word_set("need want like love require prefer seek")
SUBJECT_TAGS: Final = frozenset({Tag.NOUN, Tag.INDEFINITE, Tag.PRONOUN, Tag.RELATIVE, Tag.ANAPHOR})
# after a subject they state what someone cannot do: "my son can't find his bear"
INABILITIES: Final = word_set("can't cannot doesn't")
_LOST_STATES: Final = word_set("missing lost gone")
UNKNOWN_PEOPLE: Final = word_set("somebody someone nobody everybody everyone")
_OTHER_PEOPLE: Final = word_set("i he she they")
_REASONS: Final = word_set("because since as although though")
_CONDITIONS: Final = word_set("if whether when once until unless before after while")
_DURATIONS: Final = word_set("until before after while")
_TIMES: Final = _DURATIONS | word_set("when once")
_STRONG_CONJUNCTIONS: Final = word_set(", but +")
_PREDICATES: Final = frozenset({Tag.VERB, Tag.AUXILIARY, Tag.PARTICIPLE})
_QUESTION_OPENERS: Final = frozenset({Tag.AUXILIARY, Tag.INDEFINITE, Tag.RELATIVE})
_SUBJECT_PHRASE_TAGS: Final = frozenset({Tag.DETERMINER, Tag.ADJECTIVE, Tag.NOUN, Tag.PREPOSITION, Tag.INDEFINITE})


class ClauseType(Enum):
    """Purpose of a clause. A STATEMENT names no target, unless a later clause refers back to it."""

    REQUEST = "request"
    STATEMENT = "statement"
    REASON = "reason"


def clause_types(tagged: TaggedWords) -> dict[int, ClauseType]:
    """Return the index of each clause's first word, with the clause's type."""
    types: dict[int, ClauseType] = {}
    before = ClauseType.STATEMENT
    starts = [0, *(index for index in range(1, len(tagged)) if _begins_clause(tagged, index))]
    for start, end in zip(starts, [*starts[1:], len(tagged)], strict=True):
        before = types[start] = _clause_type(tagged, start, end, before)
    return types


def is_command(tagged: TaggedWords, index: int) -> bool:
    """Return True if the verb is an instruction: "bring", "could you bring"; not "the cups belong", "I think".

    In "find the cup bring it here", "bring" does not agree with "cup" and is an instruction.
    """
    word, subject_at = tagged[index][0], index - 1
    while subject_at >= 0 and tagged[subject_at][1] in (Tag.NEGATION, Tag.AUXILIARY):
        subject_at -= 1
    before, subject = tagged[subject_at] if subject_at >= 0 else ("", None)
    if subject is Tag.PRONOUN:
        is_relative = subject_at > 0 and tagged[subject_at - 1][1] in (Tag.RELATIVE, Tag.NOUN)  # "the cup you see"
        return before not in _OTHER_PEOPLE and not is_relative
    if subject in SUBJECT_TAGS and tagged[index - 1][0] in INABILITIES:
        return False
    if subject not in SUBJECT_TAGS or subject_at < index - 1:
        return True
    if subject is Tag.RELATIVE or verb_base(word) != word or is_question_subject(tagged, subject_at):
        return False
    return subject is not Tag.NOUN or not (before.endswith("s") or verb_base(word) in BELONGING_VERBS)


def is_question_subject(tagged: TaggedWords, subject_at: int) -> bool:
    """Return True if an auxiliary precedes the subject: "does the shelf hold"."""
    while subject_at > 0 and tagged[subject_at][1] in _SUBJECT_PHRASE_TAGS:
        subject_at -= 1
    return tagged[subject_at][1] is Tag.AUXILIARY


def _begins_clause(tagged: TaggedWords, index: int) -> bool:
    tag = tagged[index][1]
    return tag is Tag.CLAUSE_BREAK or (tag is Tag.CONJUNCTION and _opens_clause(tagged, index))


def _opens_clause(tagged: TaggedWords, conjunction_at: int) -> bool:
    """Return True if a verb, or a subject with its verb, follows the conjunction."""
    tags = [tag for _, tag in tagged[conjunction_at + 1 : conjunction_at + 3]] + [None, None]
    denied = tagged[conjunction_at + 1][0] if tags[0] is Tag.NEGATION else ""
    if denied == "no" or (denied and tags[1] is Tag.PREPOSITION) or (denied == "not" and tags[1] is Tag.DETERMINER):
        return False  # "on the table, not on the shelf", "with a lamp but no shade", "the cup, not the mug"
    asks = tagged[conjunction_at + 1][0] in ("how", "where") if tags[1] is Tag.AUXILIARY else False
    if asks or tags[0] in (Tag.VERB, Tag.NEGATION, Tag.AUXILIARY):
        return True
    if tags[0] in (Tag.PRONOUN, Tag.ANAPHOR):
        return tags[1] in _PREDICATES or tags[1] is Tag.NEGATION
    return tagged[conjunction_at][0] in _STRONG_CONJUNCTIONS and _is_statement(tagged, conjunction_at + 1)


def _is_statement(tagged: TaggedWords, start: int) -> bool:
    """Return True for a subject with its predicate: "the sun is strong", "my son dropped his toy"."""
    for index in range(start, len(tagged)):
        tag = tagged[index][1]
        if tag in (Tag.AUXILIARY, Tag.VERB):
            return index > start and not (tag is Tag.VERB and is_command(tagged, index))
        if tag not in _SUBJECT_PHRASE_TAGS and tag is not Tag.PARTICIPLE:
            return False
    return False


def _clause_type(tagged: TaggedWords, start: int, end: int, before: ClauseType) -> ClauseType:
    """Return the type of tagged[start:end]; `before` is the type of the clause before it."""
    if start == end:
        return before
    opener, first = tagged[start], start
    while first < end and tagged[first][1] in (Tag.CLAUSE_BREAK, Tag.CONJUNCTION):
        first += 1
    clause = tagged[first:end]
    if opener[1] is Tag.CLAUSE_BREAK and opener[0] in _REASONS:
        return ClauseType.REASON
    # "while I hold the door", "before it reaches the rug", "after the guests have left"
    others = clause and opener[0] in _TIMES and clause[0][0] in _OTHER_PEOPLE | {"we"}
    it_does = clause and opener[0] == "before" and clause[0][1] is Tag.ANAPHOR
    if others or it_does or (opener[0] in _DURATIONS and _is_statement(tagged, first)):
        return ClauseType.STATEMENT
    if not clause or (opener[1] is Tag.CLAUSE_BREAK and opener[0] in _CONDITIONS):
        return ClauseType.REQUEST
    is_statement = clause[0][0] in UNKNOWN_PEOPLE and len(clause) > 1 and clause[1][1] in _PREDICATES
    is_question = (clause[0][1] in _QUESTION_OPENERS or clause[0][0] == "which") and not is_statement
    if is_question or any(_is_request(tagged, index) for index in range(first, end)):
        return ClauseType.REQUEST
    # "bring the hammer. And the nails."
    elliptic = not any(tag in (Tag.AUXILIARY, Tag.VERB, Tag.PRONOUN) for _, tag in clause)
    # "there are two sinks. The one near the door."
    names = clause[0][1] in (Tag.DETERMINER, Tag.NOUN, Tag.ADJECTIVE) and opener[1] is Tag.CLAUSE_BREAK
    return ClauseType.REQUEST if elliptic and (before is ClauseType.REQUEST or names) else ClauseType.STATEMENT


def is_modal(tagged: TaggedWords, index: int) -> bool:
    """Return True for "must", and for "has" in "has to go", "needs" in "needs to be moved" or "needs cleaning"."""
    after = tagged[index + 1][1] if index + 1 < len(tagged) else None
    return tagged[index][0] in MODALS or (tagged[index][0] in SEMI_MODALS and after in (Tag.INFINITIVE, Tag.GERUND))


def _is_request(tagged: TaggedWords, index: int) -> bool:
    """Return True for a command, a wish, or a required state of an object."""
    word, tag = tagged[index]
    before = tagged[index - 1][1] if index else None
    if tag is Tag.NEGATION:
        return before is not Tag.PRONOUN and not (word in INABILITIES and before in SUBJECT_TAGS)
    if tag is Tag.GERUND:
        return before not in SUBJECT_TAGS and before is not Tag.AUXILIARY and before is not Tag.DETERMINER
    if word in _LOST_STATES and before is Tag.AUXILIARY:
        return True
    if is_modal(tagged, index) and before in SUBJECT_TAGS and before is not Tag.PRONOUN:
        return True
    if tag is not Tag.VERB or (before is Tag.INFINITIVE and _is_wish_of_another(tagged, index - 2)):
        return False
    base = verb_base(word)
    return (
        is_command(tagged, index)
        or base in BELONGING_VERBS
        or (base in WISHES and not _is_wish_of_another(tagged, index))
    )


def _is_wish_of_another(tagged: TaggedWords, index: int) -> bool:
    """Return True for "the dog wants to"."""
    tags = [tag for _, tag in tagged[max(index - 1, 0) : index + 2]]
    return tags == [Tag.NOUN, Tag.VERB, Tag.INFINITIVE] and verb_base(tagged[index][0]) in WISHES
