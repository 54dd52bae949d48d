"""Chunks: a sentence as a sequence of verbs, noun phrases, prepositions and conjunctions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum

from gausslite_language import lexicon, verbs
from gausslite_language.lexicon import DISTANCE_SUPERLATIVES, SUPERLATIVES, is_attribute, singular, word_set
from gausslite_language.nouns import is_thing
from gausslite_language.tags import Tag
from gausslite_language.tokens import Bounds

# drinking glasses have a singular, spectacles have none
_DRINK_WORDS = verbs.words("drink_words")
_DEFINITE = word_set("the this that these those my your his her its our their")
_PLACES_OF_A_THING = word_set("center centre middle edge")


@dataclass(frozen=True, slots=True)
class NounPhrase:
    """A noun phrase without its determiner, the head in the singular."""

    words: tuple[str, ...]
    has_determiner: bool
    is_definite: bool = True
    is_plural: bool = False

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
        return self.head in lexicon.NOUNS or self.head in lexicon.GENERIC or is_thing(self.head) or is_thing(self.text)


def noun_phrase(words: Sequence[str], has_determiner: bool) -> NounPhrase:
    """Return the phrase of these words of a sentence."""
    kept = list(words)
    last = kept[-1]
    if len(kept) > 1 and kept[-2] in lexicon.COMMON_ANCHORS and last in _PLACES_OF_A_THING:
        return noun_phrase(kept[:-1], has_determiner)  # "the table center"
    kept[-1] = "glass" if last == "glasses" and _DRINK_WORDS.intersection(kept) else singular(last)
    return NounPhrase(tuple(kept), has_determiner)


def phrase_from_text(text: str) -> NounPhrase:
    """Return the phrase of an object that the sentence named before."""
    return NounPhrase(tuple(text.split()), True)


def adjectives_only(words: Sequence[str]) -> bool:
    """Return True if all words are adjectives, as in "red" or "big old"."""
    return all((word in lexicon.ADJECTIVES or is_attribute(word)) and word not in lexicon.NOUNS for word in words)


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


class ChunkBuffer:
    """Collects chunks; `words` are those of the current noun phrase. index: position of the current word."""

    def __init__(self, tagged: Sequence[tuple[str, Tag]]) -> None:
        self.tagged = tagged
        self.index = 0
        self.chunks: list[Chunk] = []
        self.words: list[str] = []
        self.has_determiner = False
        self.determiner_at = 0
        self.negates_next = False

    def tag(self, offset: int) -> Tag | None:
        """Return the tag of a word by its offset from the current one; None outside the sentence."""
        position = self.index + offset
        return self.tagged[position][1] if 0 <= position < len(self.tagged) else None

    def word(self, offset: int) -> str:
        """Return a word by its offset from the current one; empty outside the sentence."""
        position = self.index + offset
        return self.tagged[position][0] if 0 <= position < len(self.tagged) else ""

    def last_kind(self, earlier: int = 0) -> ChunkKind | None:
        """Return the kind of the latest complete chunk, or of an earlier one."""
        return self.chunks[-1 - earlier].kind if len(self.chunks) > earlier else None

    def last_verb(self) -> str:
        """Return the latest verb of the sentence so far; empty without one."""
        return next((chunk.word for chunk in reversed(self.chunks) if chunk.kind is ChunkKind.VERB), "")

    def emit(self, kind: ChunkKind, word: str, gerund: bool = False) -> None:
        """End the noun phrase and add a chunk."""
        self.close()
        self.chunks.append(Chunk(kind, word, gerund=gerund))

    def emit_preposition(
        self, relation: str, text: str = "", current_place: bool = False, bounds: Bounds | None = None
    ) -> None:
        """End the noun phrase and add a preposition, negated if a "not" precedes it."""
        self.close()
        negated, self.negates_next = self.negates_next or self.joins_negated(-3), False
        place = Chunk(ChunkKind.PREPOSITION, relation, current_place=current_place, negated=negated, bounds=bounds)
        self.chunks.append(replace(place, text=text or relation))

    def joins_negated(self, place: int) -> bool:
        """Return True after "or" if the chunk at this place is negated: "not near the sink or on the table"."""
        return len(self.chunks) >= -place and self.chunks[-1].word in ("or", "nor") and self.chunks[place].negated

    def close(self) -> None:
        """End the current noun phrase."""
        if self.words:
            noun = noun_phrase(self.words, self.has_determiner)
            is_definite = self.has_determiner and self.tagged[self.determiner_at][0] in _DEFINITE
            noun = replace(noun, is_definite=is_definite, is_plural=noun.head != self.words[-1])
            self.chunks.append(Chunk(ChunkKind.NOUN, self.words[-1], noun))
        self.words, self.has_determiner = [], False


# they make a picture: "take a picture of the mug"
_PICTURING_VERBS = word_set("take make get capture shoot draw snap record want need see")


def names_object(noun: NounPhrase, pending: str | None, following: Sequence[Chunk], verb: str | None) -> bool:
    """Return False for names of the robot, and for places, routes and amounts that stand for another noun."""
    is_named = pending == "to" or verb in verbs.AVOIDING_VERBS
    is_named = (noun.has_determiner and is_named) or (noun.is_plural and pending == "with")
    if len(noun.words) == 1 and noun.head in lexicon.ADDRESSEES and not is_named:
        return False
    if noun.head in lexicon.TASK_NOUNS and pending is None:
        return False
    of_follows = bool(following) and following[0].kind is ChunkKind.PREPOSITION and following[0].word == "of"
    content = following[1].noun if of_follows and len(following) > 1 else None
    is_picture = noun.head in lexicon.PICTURES and verb not in _PICTURING_VERBS
    if content is not None and not (content.has_determiner or is_picture or noun.head in lexicon.CONTAINERS):
        return False  # "a bar of soap"
    if of_follows and is_picture:
        return True
    compound = len(noun.words) > 1 and not adjectives_only(noun.words[:-1])
    if (compound or lexicon.COLOURS.intersection(noun.words)) and noun.head in lexicon.PLACES and not of_follows:
        return True  # "on the yellow area"
    if noun.head in lexicon.PHYSICAL_MEASURES and verb in verbs.HANDLING_VERBS and pending is None and not of_follows:
        return True
    unlikely = lexicon.TIME_NOUNS if noun.has_determiner else lexicon.MANNER_NOUNS | lexicon.TIME_NOUNS
    likely = (None, "from", "of", "to", "on", "with" if noun.has_determiner else None)
    if noun.head in unlikely and adjectives_only(noun.words[:-1]) and pending not in likely:
        return False
    return _names_by_kind(noun, pending, verb, of_follows, compound)


def _names_by_kind(noun: NounPhrase, pending: str | None, verb: str | None, of_follows: bool, compound: bool) -> bool:
    if noun.head in lexicon.BUILDINGS:
        return pending != "inside" or bool(noun.words[1:])
    if noun.head in lexicon.PLACES:
        if pending == "to" and lexicon.is_space(noun.words):
            return True  # "to the cold room"
        return noun.head in lexicon.PHYSICAL_PLACES and pending not in (None, "inside", "to") and not of_follows
    if noun.words == ("light",) and of_follows and pending is not None:
        return False  # "by the light of the lamp"
    if noun.head in lexicon.ROUTES and not compound and noun.words[0] not in lexicon.COLOURS:
        return pending not in (None, "of", "for", "to")
    if noun.head in lexicon.MEASURES and pending not in (None, "of"):
        return not of_follows
    # "the smallest piece"
    described = len(noun.words) > 1 and verb not in _PICTURING_VERBS
    known = noun.head in lexicon.NOUNS or (noun.is_known and pending != "of")
    return noun.head not in lexicon.MEASURES or ((known or compound or described) and not of_follows)
