"""What a sentence is read as: a row of verbs, noun phrases, prepositions and joints."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from gausslite.task.phrases import NounPhrase


class TokenKind(Enum):
    """What a piece of a sentence is."""

    VERB = "verb"
    BELONGS = "belongs"
    NOUN = "noun"
    PREPOSITION = "preposition"
    JOIN = "join"
    BREAK = "break"
    ASIDE = "aside"
    NEGATION = "negation"
    BACK_REFERENCE = "back reference"
    POINTING = "pointing"


@dataclass(frozen=True, slots=True)
class Piece:
    """One piece: the verb's base form, the preposition's relation, the joint's word, or a noun phrase.

    stated: the place is where something is ("that is on"), and not where it is to go.
    """

    kind: TokenKind
    word: str
    noun: NounPhrase | None = None
    gerund: bool = False
    stated: bool = False
