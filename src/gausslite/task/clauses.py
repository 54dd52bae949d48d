"""Find the clauses of a tagged sentence, and which of them ask for something, state something or give a reason."""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum
from typing import Final

from gausslite.task.tags import Tag
from gausslite.task.verb_forms import verb_base
from gausslite.task.verbs import BELONGING_VERBS
from gausslite.task.words import words

Tagged = Sequence[tuple[str, Tag]]

NOMINATIVES: Final = words("i you we he she they")
MODALS: Final = words("must should ought")
PERHAPS_MODAL: Final = words("has have had need needs")
WISHES: Final = words("need want like love require prefer seek")
SUBJECTS: Final = frozenset({Tag.NOUN, Tag.STAND_IN, Tag.PRONOUN, Tag.RELATIVE, Tag.BACK_REFERENCE})
_LOST: Final = words("missing lost gone")
_OTHERS: Final = words("i he she they")
_REASONS: Final = words("because since as although though")
_CONDITIONS: Final = words("if whether when once until unless before after while")
_TIMES: Final = words("when once until before after while")
_STARKER_JOINS: Final = words(", but +")
_PREDICATES: Final = frozenset({Tag.VERB, Tag.AUXILIARY, Tag.PARTICIPLE})
_QUESTION_OPENERS: Final = frozenset({Tag.AUXILIARY, Tag.STAND_IN, Tag.RELATIVE})
_IN_A_SUBJECT: Final = frozenset({Tag.DETERMINER, Tag.ADJECTIVE, Tag.NOUN, Tag.PREPOSITION, Tag.STAND_IN})


class Mood(Enum):
    """What a clause is for; an aside names nothing that is to be done unless a later clause points back at it."""

    TASK = "task"
    ASIDE = "aside"
    REASON = "reason"


def moods_of(said: Tagged) -> dict[int, Mood]:
    """The first index of each clause, and its mood."""
    moods: dict[int, Mood] = {}
    before = Mood.ASIDE
    starts = [0, *(at for at in range(1, len(said)) if _begins_clause(said, at))]
    for start, end in zip(starts, [*starts[1:], len(said)], strict=True):
        before = moods[start] = _mood(said, start, end, before)
    return moods


def commands(said: Tagged, at: int) -> bool:
    """True where the verb at this index is to be done: "bring", "could you bring", not "the cups belong", "I think".

    In "find the cup bring it here" the form tells: no single cup "bring".
    """
    word, subject_at = said[at][0], at - 1
    while subject_at >= 0 and said[subject_at][1] in (Tag.NEGATION, Tag.AUXILIARY):
        subject_at -= 1
    before, subject = said[subject_at] if subject_at >= 0 else ("", None)
    if subject is Tag.PRONOUN:
        related = subject_at > 0 and said[subject_at - 1][1] is Tag.RELATIVE
        return before not in _OTHERS and not related
    if subject not in SUBJECTS or subject_at < at - 1:
        return True
    if subject is Tag.RELATIVE or verb_base(word) != word or _is_asked_about(said, subject_at):
        return False
    return subject is not Tag.NOUN or not (before.endswith("s") or verb_base(word) in BELONGING_VERBS)


def _is_asked_about(said: Tagged, subject_at: int) -> bool:
    """True for the shelf in "does the shelf hold"."""
    while subject_at > 0 and said[subject_at][1] in _IN_A_SUBJECT:
        subject_at -= 1
    return said[subject_at][1] is Tag.AUXILIARY


def _begins_clause(said: Tagged, at: int) -> bool:
    tag = said[at][1]
    return tag is Tag.BREAK or (tag is Tag.JOIN and _opens_clause(said, at))


def _opens_clause(said: Tagged, join: int) -> bool:
    """Behind a joint: a verb, or a subject with its verb."""
    tags = [tag for _, tag in said[join + 1 : join + 3]] + [None, None]
    if tags[0] in (Tag.VERB, Tag.NEGATION, Tag.AUXILIARY):
        return True
    if tags[0] in (Tag.PRONOUN, Tag.BACK_REFERENCE):
        return tags[1] in _PREDICATES
    return said[join][0] in _STARKER_JOINS and _is_statement(said, join + 1)


def _is_statement(said: Tagged, start: int) -> bool:
    """True for a subject and what it does: "the sun is strong", "my son dropped his toy"."""
    for at in range(start, len(said)):
        tag = said[at][1]
        if tag in (Tag.AUXILIARY, Tag.VERB):
            return at > start and not (tag is Tag.VERB and commands(said, at))
        if tag is Tag.PARTICIPLE and at + 1 < len(said) and said[at + 1][1] is Tag.DETERMINER:
            return at > start
        if tag not in _IN_A_SUBJECT and tag is not Tag.PARTICIPLE:
            return False
    return False


def _mood(said: Tagged, start: int, end: int, before: Mood) -> Mood:
    if start == end:
        return before
    opener, first = said[start], start
    while first < end and said[first][1] in (Tag.BREAK, Tag.JOIN):
        first += 1
    clause = said[first:end]
    if opener[1] is Tag.BREAK and opener[0] in _REASONS:
        return Mood.REASON
    if clause and opener[0] in _TIMES and clause[0][0] in _OTHERS | {"we"}:
        return Mood.ASIDE  # "while I hold the door"
    if not clause or (opener[1] is Tag.BREAK and opener[0] in _CONDITIONS):
        return Mood.TASK
    if any(_asks(said, at) for at in range(first, end)) or clause[0][1] in _QUESTION_OPENERS or clause[0][0] == "which":
        return Mood.TASK
    # "bring the hammer. And the nails."
    elliptic = not any(tag in (Tag.AUXILIARY, Tag.VERB, Tag.PRONOUN) for _, tag in clause)
    return before if elliptic and before is Mood.TASK else Mood.ASIDE


def is_modal(said: Tagged, at: int) -> bool:
    """True for "must", and for "has" in "has to go", "needs" in "needs to be moved" or "needs cleaning"."""
    after = said[at + 1][1] if at + 1 < len(said) else None
    return said[at][0] in MODALS or (said[at][0] in PERHAPS_MODAL and after in (Tag.INFINITIVE, Tag.ING))


def _asks(said: Tagged, at: int) -> bool:
    """A command, a wish, or what has to become of a thing."""
    word, tag = said[at]
    before = said[at - 1][1] if at else None
    if tag is Tag.NEGATION:
        return before is not Tag.PRONOUN
    if tag is Tag.ING:
        return before not in SUBJECTS and before is not Tag.AUXILIARY and before is not Tag.DETERMINER
    if word in _LOST and before is Tag.AUXILIARY:
        return True
    if is_modal(said, at) and before in SUBJECTS and before is not Tag.PRONOUN:
        return True
    if tag is not Tag.VERB:
        return False
    base = verb_base(word)
    return commands(said, at) or base in BELONGING_VERBS or base in WISHES
