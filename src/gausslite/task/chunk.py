"""What a sentence is read as: a row of verbs, noun phrases, prepositions and joints."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from gausslite.task.noun_phrase import NounPhrase


class ChunkKind(Enum):
    """What a chunk of a sentence is."""

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


@dataclass(frozen=True, slots=True)
class Chunk:
    """One chunk: the verb's base form, the preposition's relation, the joint's word, or a noun phrase.

    current_place: the place is where something is ("that is on"), and not where it is to go.
    """

    kind: ChunkKind
    word: str
    noun: NounPhrase | None = None
    gerund: bool = False
    current_place: bool = False
