"""Read a sentence as a row of verbs, noun phrases, prepositions and joints, without yet asking what they mean."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Final

from gausslite.task import lexicon
from gausslite.task.idioms import plain_words
from gausslite.task.phrases import NounPhrase, adjectives_only, noun_phrase
from gausslite.task.prepositions import LONGEST_PREPOSITION, PREPOSITIONS
from gausslite.task.singular import singular
from gausslite.task.verbs import is_participle, verb_base
from gausslite.task.words import words

_TOKEN: Final = re.compile(r"[^\W\d_][\w'’-]*|\d[\w.]*|[,/&+;.!?:()]")
_BREAKS: Final = words(". ; : ! ? then while before after until when once if whether where because afterwards")
_RELATIVES: Final = frozenset({"that", "which", "who"})
_BACK_REFERENCES: Final = frozenset({"it", "them"})
_POINTING: Final = frozenset({"this", "that", "these", "those"})
_SUBJECTS: Final = frozenset({"i", "we", "you", "he", "she", "they"})
# "go stand", "help clean": the second is what is to be done
_LEADING_VERBS: Final = frozenset({"go", "come", "help", "start", "stop", "begin"})
_ADVERB_ENDINGS: Final = ("wise", "wards")
_PARTICLES_ONLY: Final = words("up down out away back forward backward apart upstairs downstairs")
_LONGEST_NEGATION: Final = max(len(words) for words in lexicon.NEGATIONS)
_SUPERLATIVES: Final = frozenset({"closest", "nearest"})


class Kind(Enum):
    """What a piece of a sentence is."""

    VERB = "verb"
    NOUN = "noun"
    PREPOSITION = "preposition"
    JOIN = "join"
    BREAK = "break"
    NEGATION = "negation"
    BACK_REFERENCE = "back reference"
    POINTING = "pointing"


@dataclass(frozen=True, slots=True)
class Piece:
    """One piece: the verb's base form, the preposition's relation, the joint's word, or a noun phrase."""

    kind: Kind
    word: str
    noun: NounPhrase | None = None
    gerund: bool = False


def tokens_of(text: str) -> list[str]:
    """Lower-case words, numbers and the punctuation that matters."""
    return _TOKEN.findall(plain_words(text))


def read(text: str) -> list[Piece]:
    """The pieces of one normalised sentence, in order."""
    return _Reader(tokens_of(text)).read()


class _Reader:
    """Walks the tokens once, collecting the words of the noun phrase that is open."""

    def __init__(self, tokens: Sequence[str]) -> None:
        self.tokens = tokens
        self.at = 0
        self.pieces: list[Piece] = []
        self.words: list[str] = []
        self.determined = False
        self.superlative = False
        self.relative_at = -2

    def read(self) -> list[Piece]:
        while self.at < len(self.tokens):
            if not (self._negation() or self._preposition()):
                self._word(self.tokens[self.at])
                self.at += 1
        self._close()
        return self.pieces

    def _peek(self, ahead: int = 1) -> str:
        position = self.at + ahead
        return self.tokens[position] if 0 <= position < len(self.tokens) else ""

    def _last(self) -> Kind | None:
        return self.pieces[-1].kind if self.pieces else None

    def _follows_noun(self) -> bool:
        return bool(self.words) or self._last() is Kind.NOUN

    def _emit(self, kind: Kind, word: str, gerund: bool = False) -> None:
        self._close()
        self.pieces.append(Piece(kind, word, gerund=gerund))

    def _close(self) -> None:
        """End the open noun phrase."""
        if self.words:
            self.pieces.append(
                Piece(Kind.NOUN, self.words[-1], noun_phrase(self.words, self.determined, self.superlative))
            )
        self.words, self.determined, self.superlative = [], False, False

    def _negation(self) -> bool:
        if self.words and self.tokens[self.at] == "no":
            return False
        gerund = self._peek().endswith("ing") and verb_base(self._peek()) and self._peek() not in lexicon.ADJECTIVES
        if self.tokens[self.at] in ("avoid", "avoiding") and gerund:
            self._emit(Kind.NEGATION, "avoid")
            self.at += 1
            return True
        for length in range(_LONGEST_NEGATION, 0, -1):
            said = tuple(self.tokens[self.at : self.at + length])
            if len(said) == length and said in lexicon.NEGATIONS:
                self._emit(Kind.NEGATION, " ".join(said))
                self.at += length
                return True
        return False

    def _preposition(self) -> bool:
        for length in range(LONGEST_PREPOSITION, 0, -1):
            said = " ".join(self.tokens[self.at : self.at + length])
            relation = PREPOSITIONS.get(said)
            if relation is None or len(self.tokens) < self.at + length:
                continue
            after = self._peek(length)
            if said in _SUPERLATIVES and not (self._follows_noun() and after in lexicon.DETERMINERS):
                return False
            if length == 1 and self._is_particle(said, after):
                self.at += 1
                return True
            if self._is_purpose(said, after):
                self._close()
            else:
                self._emit(Kind.PREPOSITION, relation)
            self.at += length
            return True
        return False

    def _is_particle(self, word: str, after: str) -> bool:
        """`on` in "turn on the lamp" and `off` in "turn the lamp off" belong to the verb."""
        if not self.words and self._last() is Kind.VERB:
            if word in ("on", "in"):
                return self.pieces[-1].word in lexicon.ON_IN_PARTICLE_VERBS and word == "on"
            return word in lexicon.PARTICLES
        ends = not after or after in lexicon.CONJUNCTIONS or after in _BREAKS
        return ends and word not in ("to", "of")

    def _is_purpose(self, said: str, after: str) -> bool:
        """The word "to" before a verb, or any preposition before a gerund, opens a clause and not a place."""
        base = verb_base(after)
        if base is None:
            return False
        if after.endswith("ing") and after not in lexicon.NOUNS:
            return said in ("to", "for", "by", "before", "after")
        beyond = self._peek(2)
        plain_noun = after in lexicon.NOUNS and not self._starts_noun(beyond) and beyond not in lexicon.PARTICLES
        return said == "to" and not plain_noun

    def _starts_noun(self, word: str) -> bool:
        known = word in lexicon.CONJUNCTIONS or word in _BREAKS or word in lexicon.FILLERS or word in PREPOSITIONS
        return bool(word) and not known

    def _word(self, word: str) -> None:
        if word in _BREAKS:
            self._emit(Kind.BREAK, word)
        elif word in lexicon.CONJUNCTIONS or word in "()":
            self._emit(Kind.JOIN, word)
        elif word in _BACK_REFERENCES:
            self._emit(Kind.BACK_REFERENCE, word)
        elif word in _RELATIVES and self._follows_noun() and not self._starts_known_noun(1):
            self._close()
            self.relative_at = self.at
        elif word in _POINTING and not self._points_at_noun():
            self._emit(Kind.POINTING, word)
        elif self._determines(word):
            self._determiner()
        elif word in _SUPERLATIVES:
            self.superlative = True
        elif word in lexicon.PRONOUNS or (word in _PARTICLES_ONLY and (self.words or not self.determined)):
            self._close()
        elif word in lexicon.STAND_INS:
            self._close()
            self.words.append(lexicon.STAND_INS[word])
            self._close()
        elif word in lexicon.FILLERS and not self._belongs_to_noun(word):
            self._close()
        elif not self._verb(word):
            self._content(word)

    def _determines(self, word: str) -> bool:
        article = word in lexicon.DETERMINERS and (word, self._peek()) not in lexicon.COMPOUND_OPENERS
        return article or word[0].isdigit() or (word.endswith(("'s", "s'")) and len(word) > 3)

    def _determiner(self) -> None:
        if self.words:
            self._close()
        self.determined = True

    def _belongs_to_noun(self, word: str) -> bool:
        """In "the standing lamp" a participle describes a noun; "the trash can" is no modal verb."""
        if word == "can":
            return (bool(self.words) or self.determined) and verb_base(self._peek()) is None
        return self.determined and not self.words and word.endswith("ing") and self._starts_noun(self._peek())

    def _verb(self, word: str) -> bool:
        """Take the word as a verb if it stands where a verb can stand."""
        base = verb_base(word)
        after, gerund = self._peek(), word.endswith("ing")
        if self._has_subject(word):
            return True
        if base is None:
            return self._is_state(word, after) or self._unknown_verb(word, after)
        if self.words:
            return word not in lexicon.NOUNS and self._describes(word, after)
        if self.determined or (self._last() is Kind.PREPOSITION and not gerund):
            return False
        if self._last() is Kind.NOUN and gerund and self._participle(after):
            return True
        could_be_noun = noun_phrase([word], False, False).known and base not in lexicon.GO_VERBS
        if self._last() is Kind.VERB and self.pieces[-1].word in _LEADING_VERBS:
            could_be_noun = False
        if not self.pieces and base in lexicon.TOOL_VERBS and (after in PREPOSITIONS or after in lexicon.PLACES):
            could_be_noun = False
        if could_be_noun and not (self._starts_noun(after) or after in lexicon.PARTICLES):
            return False
        self._emit(Kind.VERB, base, gerund)
        return True

    def _describes(self, word: str, after: str) -> bool:
        """A verb behind its noun: "the boxes stacked on the cart", "the shelf holds the cans"."""
        if word.endswith("ing") or (word.endswith("s") and after in lexicon.DETERMINERS):
            return self._participle(after)
        return is_participle(word) and after in PREPOSITIONS and self._participle(after)

    def _has_subject(self, word: str) -> bool:
        """In "the screws that fell" and "I lost my wallet" the word is what the subject does, whatever it is."""
        if self.words or self.determined or word in lexicon.NOUNS:
            return False
        if self.relative_at == self.at - 1:
            return True
        return self._peek(-1) in _SUBJECTS and (verb_base(word) is None or self.relative_at == self.at - 2)

    def _is_state(self, word: str, after: str) -> bool:
        """In "whether the light is blinking" the last word names no object."""
        unknown = bool(self.words) and word.endswith("ing") and singular(self.words[-1]) in lexicon.NOUNS
        participle = bool(self.words) and (unknown or is_participle(word))
        if participle and word not in lexicon.NOUNS and after in PREPOSITIONS:
            self._close()
            return True
        plain = not (self.words or self.determined) and singular(word) not in lexicon.NOUNS
        return plain and self._peek(-1) in lexicon.COPULAS and not self._starts_noun(after)

    def _starts_known_noun(self, ahead: int) -> bool:
        """True where a noun of the lexicon follows, perhaps after adjectives."""
        while self._peek(ahead) in lexicon.ADJECTIVES:
            ahead += 1
        word = self._peek(ahead)
        return bool(word) and singular(word) in lexicon.NOUNS and verb_base(word) is None

    def _points_at_noun(self) -> bool:
        """In "this mug" the word describes a noun; in "pick this up" it stands for one."""
        after = self._peek()
        return (
            bool(after) and (after in lexicon.DETERMINERS or self._starts_noun(after)) and after not in _PARTICLES_ONLY
        )

    def _unknown_verb(self, word: str, after: str) -> bool:
        """In "rearrange the cushions" only a verb can stand before the article."""
        opens = not (self.words or self.determined or self._follows_noun() or self._last() is Kind.PREPOSITION)
        if opens and word not in lexicon.NOUNS and after in lexicon.DETERMINERS:
            self._emit(Kind.VERB, word)
            return True
        return False

    def _participle(self, after: str) -> bool:
        """In "the person holding a cup" the cup is beside the person."""
        if after in lexicon.DETERMINERS:
            self._emit(Kind.PREPOSITION, "near")
            return True
        if after in PREPOSITIONS or not after:
            self._close()
            return True
        return False

    def _content(self, word: str) -> None:
        final_noun = self.determined and not self._starts_noun(self._peek())
        adverb = word.endswith(_ADVERB_ENDINGS) or (word.endswith("ly") and not final_noun)
        if adverb and word not in lexicon.NOUNS:
            return
        # "the red and blue mugs": an adjective on its own waits for the noun of the next phrase
        if not self.words and self._last() is Kind.JOIN and len(self.pieces) >= 2:
            before = self.pieces[-2].noun
            if before is not None and adjectives_only(before.words):
                self.determined = before.determined
        self.words.append(word)
