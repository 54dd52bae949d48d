"""Count the words of a sentence against its graph: nouns that it lost, and names that end in an unknown word."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from gausslite_language import lexicon
from gausslite_language.chunk import noun_phrase
from gausslite_language.clause_types import ClauseType, clause_types
from gausslite_language.graph_draft import GraphDraft
from gausslite_language.lexicon import singular, word_set
from gausslite_language.spelling import is_in_dictionary
from gausslite_language.tags import Tag, is_english

_NO_OBJECTS: Final = lexicon.PLACES | lexicon.TIME_NOUNS | {"one", "ones"}
# "a leak" may be no object, "the leak" is one
_NO_OBJECTS_BARE: Final = frozenset().union(
    *(lexicon.ADDRESSEES, lexicon.TASK_NOUNS, lexicon.MEASURES, lexicon.ROUTES, lexicon.BODY_PARTS),
    lexicon.MANNER_NOUNS,
)
_DEFINITE: Final = word_set("the this these those")
_CLOSERS: Final = frozenset({Tag.NOUN, Tag.ADJECTIVE, Tag.GERUND, Tag.PARTICIPLE})
_PREDICATES: Final = frozenset({Tag.VERB, Tag.AUXILIARY, Tag.PARTICIPLE})
_AFTER_CALLED: Final = _PREDICATES | {Tag.CONJUNCTION, Tag.CLAUSE_BREAK}  # "drone, fly to the roof"
_BEFORE_STATES: Final = frozenset({Tag.AUXILIARY, Tag.PRONOUN})


def lost_nouns(tagged: Sequence[tuple[str, Tag]], draft: GraphDraft) -> tuple[str, ...]:
    """Return the nouns of a sentence that are in no part of its graph and in no warning.

    A word that closes a phrase after "the" counts as a noun, whatever its tag: "carry the injured". Reasons, who acts
    in a statement, states ("I am hungry") and one side of an "of" do not count.
    """
    names = (*draft.targets, *draft.anchors, *draft.excluded, *draft.context, *draft.warnings)
    used = {singular(word.strip("'")) for name in names for word in name.split()} | _NO_OBJECTS
    types, clause, is_definite = clause_types(tagged), ClauseType.REQUEST, False
    lost: dict[str, None] = {}
    padded = [("", None), ("", None), *tagged, ("", None), ("", None)]
    for index, (word, tag) in enumerate(tagged):
        clause = types.get(index, clause)
        before, next_tag = padded[index + 1][1], padded[index + 3][1]
        is_definite = word in _DEFINITE or (is_definite and tag in _CLOSERS and before is not Tag.NOUN)
        acts = clause is ClauseType.STATEMENT and next_tag in (_PREDICATES if index else _AFTER_CALLED)
        acts = acts and not (next_tag is Tag.AUXILIARY and padded[index + 4][1] is Tag.PREPOSITION)
        closes = next_tag is not Tag.NOUN if tag is Tag.NOUN else is_definite and next_tag not in _CLOSERS
        unknown = word.isalpha() and not is_english(word) and not is_in_dictionary(word)
        acts = acts or clause is ClauseType.REASON or before in _BEFORE_STATES
        if not unknown and (tag not in _CLOSERS or not closes or acts):
            continue
        known = used if is_definite else used | _NO_OBJECTS_BARE
        known = known | lexicon.DEFECTS if ("for", Tag.PREPOSITION) in tagged[:index] else known
        if not ({word, singular(word)} & known or _is_amount(tagged, index, used)):
            lost[singular(word)] = None
    return tuple(lost)


def _is_amount(tagged: Sequence[tuple[str, Tag]], index: int, used: set[str]) -> bool:
    """Return True for both sides of an "of" if the graph has one of them: "a bar of soap", "a bottle of water"."""
    words = [word for word, _ in tagged]
    content = next((word for word, tag in tagged[index + 2 : index + 5] if tag is Tag.NOUN), "")
    before = [at for at in range(max(index - 3, 0), index) if words[at] == "of"]
    container = words[before[-1] - 1] if before and before[-1] else ""
    return bool({singular(content) if words[index + 1 : index + 2] == ["of"] else "", singular(container)} & used)


def unknown_names(draft: GraphDraft) -> tuple[str, ...]:
    """Return the names of a graph that end in a word which no list has, or only as a verb or an adjective."""
    phrases = (*draft.targets, *draft.anchors, *draft.excluded)
    nouns = (noun_phrase(phrase.split(), False) for phrase in phrases)
    return tuple(
        noun.text
        for noun in nouns
        if not noun.is_known and (is_english(noun.head) or not is_in_dictionary(noun.head) or noun.head[-3:] == "ing")
    )
