"""Chunks: a sentence as a sequence of verbs, noun phrases, prepositions and conjunctions."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from gausslite.task.distances import Bounds
from gausslite.task.noun_phrase import NounPhrase


class ChunkKind(Enum):
    """Kind of a chunk.

    SUBJECT_VERB: a verb whose objects precede it ("the mugs belong in the cupboard"). STATEMENT: the start of a
    clause that requests nothing. ANAPHOR: "it" or "them". DEMONSTRATIVE: "this" or "those" without a noun.
    ATTRIBUTE: a colour or superlative of the noun before it ("the mug that is red").
    NOT_UNDERSTOOD: words without a place in a graph ("that is not broken").
    """

    VERB = "verb"
    SUBJECT_VERB = "subject verb"
    NOUN = "noun"
    PREPOSITION = "preposition"
    CONJUNCTION = "conjunction"
    CLAUSE_BREAK = "clause break"
    STATEMENT = "statement"
    NEGATION = "negation"
    ANAPHOR = "anaphor"
    DEMONSTRATIVE = "demonstrative"
    ATTRIBUTE = "attribute"
    NOT_UNDERSTOOD = "not understood"


@dataclass(frozen=True, slots=True)
class Chunk:
    """One chunk; word is the verb's base form, the preposition's relation, the conjunction or the noun's head.

    current_place: the preposition states where something is ("that is on"), not where to put it. negated: the
    preposition or attribute does not hold. text: the preposition itself. bounds: the distance of a preposition.
    """

    kind: ChunkKind
    word: str
    noun: NounPhrase | None = None
    gerund: bool = False
    current_place: bool = False
    negated: bool = False
    text: str = ""
    bounds: Bounds | None = None
