"""Read what was typed in a hurry: abbreviations of chat, and unknown words with one typing error."""

from __future__ import annotations

import functools
import re
from dataclasses import dataclass
from importlib import resources
from string import ascii_lowercase
from typing import Final

from gausslite_language.lexicon import NOUNS
from gausslite_language.nouns import is_thing, vocabulary
from gausslite_language.tags import is_english
from gausslite_language.tokens import PREPOSITIONS
from gausslite_language.verbs import TABLES, VERBS, word_set

_SHORT_FORMS: Final[dict[str, str]] = TABLES["abbreviations"]
_SHORT_FORM: Final = re.compile(rf"(?<![\w/'-])(?:{'|'.join(map(re.escape, _SHORT_FORMS))})(?![\w/'-])")
_CONTRACTIONS: Final = frozenset(word for word in _SHORT_FORMS if len(word) > 4 and word.isalpha())
_NAME: Final = re.compile(r"(?<=[\w,] )[A-Z]\w+")
_WORD: Final = re.compile(r"(?<![\w'-])[^\W\d_]{3,}(?![\w'-])")
# "an aple", "the flor and": words after an article, at the end of the phrase
_LAST: Final = re.compile(rf"\b(?:an?|the|my) (\w+)(?=$|[,.;!?]| (?:{'|'.join(sorted(PREPOSITIONS))}|and|or|is|are)\b)")
_COMMON: Final = NOUNS | VERBS
_RARER: Final = 20  # how much more often the common word occurs
_LISTED: Final = frozenset().union(*(word_set(line) for line in TABLES.values() if isinstance(line, str)))


@dataclass(frozen=True, slots=True)
class Reading:
    """A sentence without the errors that were found, and a warning for each."""

    text: str
    warnings: tuple[str, ...] = ()


def read_typed(text: str, normalised: str) -> Reading:
    """Return the reading of a normalised text. Words with a capital inside the original text are names, and stay."""
    names = {name.casefold() for name in _NAME.findall(text)}
    plain = _SHORT_FORM.sub(lambda match: _SHORT_FORMS[match[0]], normalised)
    words = dict.fromkeys(_WORD.findall(plain))
    unknown = [word for word in words if word not in names and not is_english(word)]
    last = {match[1] for match in _LAST.finditer(plain)}
    corrected = {word: nearest for word in unknown if (nearest := nearest_word(word, word in last)) is not None}
    # a text of strange words is not English with typing errors
    if len(unknown) - len(corrected) > len(words) - len(unknown):
        corrected = {}
    if corrected:
        plain = _WORD.sub(lambda match: corrected.get(match[0], match[0]), plain)
    return Reading(plain, tuple(f"{word!r} is read as {nearest!r}" for word, nearest in corrected.items()))


@functools.lru_cache(maxsize=1024)
def nearest_word(word: str, ends_phrase: bool = False) -> str | None:
    """Return the known word that is one typing error away, a noun if it ends a phrase; None without such a word.

    For an English word that no list has, only a common word counts from which letters are missing: "flor", "truk".
    """
    frequencies = _frequencies()
    near = _with_one_error(word) & (frequencies.keys() | vocabulary().senses.keys() | _CONTRACTIONS)
    usable = [known for known in near if is_english(known) or known in _CONTRACTIONS]
    if word in frequencies:
        least = _RARER * frequencies[word]
        usable = [known for known in near & _COMMON if frequencies.get(known, 0) > least and _error(word, known) < 2]
    found = min(
        usable,
        key=lambda known: (
            *(ends_phrase and (known[0] != word[0] or not (known in NOUNS or is_thing(known))), _error(word, known)),
            *(known not in _LISTED | _CONTRACTIONS, -frequencies.get(known, 0), known),
        ),
        default="",
    )
    return _SHORT_FORMS.get(found, found) or None


def is_in_dictionary(word: str) -> bool:
    """Return True for an English word, also of a kind that the parser has no list of."""
    return word in _frequencies()


def _with_one_error(word: str) -> set[str]:
    """Return what one typing error makes of a word: two letters swapped, one missing, one too many, or another."""
    parts = [(word[:place], word[place:]) for place in range(len(word) + 1)]
    swapped = {f"{head}{tail[1]}{tail[0]}{tail[2:]}" for head, tail in parts if len(tail) > 1}
    shorter = {head + tail[1:] for head, tail in parts if tail}
    longer = {head + letter + tail for head, tail in parts for letter in ascii_lowercase}
    other = {head + letter + tail[1:] for head, tail in parts if tail for letter in ascii_lowercase}
    return (swapped | shorter | longer | other) - {word}


def _error(typed: str, meant: str) -> int:
    """Return the rank of the typing error, the likeliest first: letters swapped, one missing, one too many, another."""
    if sorted(typed) == sorted(meant):
        return 0
    return 1 if len(meant) > len(typed) else 2 if len(meant) < len(typed) else 3


@functools.cache
def _frequencies() -> dict[str, int]:
    """Return how often each English word occurs. The library's file is read once, at the first unknown word."""
    path = resources.files("symspellpy").joinpath("frequency_dictionary_en_82_765.txt")
    rows = (line.split() for line in path.read_text(encoding="utf-8-sig").splitlines())
    return {word: int(count) for word, count in rows}
