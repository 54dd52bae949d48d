"""Noun phrases: words without determiners, the head in the singular."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from gausslite.task import lexicon
from gausslite.task.attributes import DISTANCE_SUPERLATIVES, SUPERLATIVES, is_attribute
from gausslite.task.singular import singular
from gausslite.task.word_set import word_set

# drinking glasses have a singular, spectacles have none
_DRINK_WORDS = word_set(
    "wine beer water champagne drinking cocktail juice whisky whiskey shot pint milk measuring dirty empty"
)


@dataclass(frozen=True, slots=True)
class NounPhrase:
    """A noun phrase without its determiner, the head in the singular."""

    words: tuple[str, ...]
    has_determiner: bool

    @property
    def head(self) -> str:
        """The noun without its adjectives."""
        return self.words[-1]

    @property
    def distance_superlative(self) -> str | None:
        """The word "nearest" or "farthest" (or a synonym) of the phrase; None without one."""
        return next((word for word in self.words[:-1] if SUPERLATIVES.get(word) in DISTANCE_SUPERLATIVES), None)

    @property
    def text(self) -> str:
        """The phrase as it is passed to a detector."""
        return " ".join(self.words)

    @property
    def is_known(self) -> bool:
        """True when the head is a noun of the lexicon."""
        return self.head in lexicon.NOUNS or self.head in lexicon.GENERIC


def noun_phrase(words: Sequence[str], has_determiner: bool) -> NounPhrase:
    """Return the phrase of these words of a sentence."""
    kept = list(words)
    last = kept[-1]
    kept[-1] = "glass" if last == "glasses" and _DRINK_WORDS.intersection(kept) else singular(last)
    return NounPhrase(tuple(kept), has_determiner)


def phrase_from_text(text: str) -> NounPhrase:
    """Return the phrase of an object that the sentence named before."""
    return NounPhrase(tuple(text.split()), True)


def adjectives_only(words: Sequence[str]) -> bool:
    """Return True if all words are adjectives, as in "red" or "big old"."""
    return all((word in lexicon.ADJECTIVES or is_attribute(word)) and word not in lexicon.NOUNS for word in words)
