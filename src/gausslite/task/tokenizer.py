"""Split a sentence into words, with multi-word prepositions and negations as one unit: "next to", "do not"."""

from __future__ import annotations

import re
from typing import Final

from gausslite.task import lexicon
from gausslite.task.distances import Bounds, bounds_of
from gausslite.task.idioms import replace_idioms
from gausslite.task.prepositions import PREPOSITIONS

_TOKEN: Final = re.compile(r"[^\W\d_][\w'’-]*|\d[\w.]*|[,/&+;.!?:()]")
_BOUNDS_SIGN: Final = "@"  # no token contains it
_UNITS: Final = [
    *(tuple(preposition.split()) for preposition in PREPOSITIONS if " " in preposition),
    *(negation for negation in lexicon.NEGATIONS if len(negation) > 1),
]
# by their first word, the longest first
_COMPOUNDS: Final = {
    first: sorted((unit for unit in _UNITS if unit[0] == first), key=len, reverse=True)
    for first in {unit[0] for unit in _UNITS}
}


def tokenize(text: str) -> list[str]:
    """Return the lower-case words, the numbers and the relevant punctuation of a text without idioms."""
    return _TOKEN.findall(replace_idioms(text))


def lexical_units(text: str) -> list[str]:
    """Return the tokens of a text, with multi-word prepositions and negations merged."""
    tokens = tokenize(text)
    units: list[str] = []
    start = 0
    bounds = ""
    while start < len(tokens):
        marked = bounds_of(tokens[start])
        if marked is not None:
            bounds = f"{_BOUNDS_SIGN}{tokens[start]}"
            if marked.stands_alone:
                units.append(f"near{bounds}")
                bounds = ""
            start += 1
            continue
        compounds = _COMPOUNDS.get(tokens[start], ())
        length = next((len(unit) for unit in compounds if tuple(tokens[start : start + len(unit)]) == unit), 1)
        if length > 1 and tokens[start + length - 1] == "to" and _begins_preposition(tokens, start + length - 1):
            length -= 1  # "not to the left of"
        unit = " ".join(tokens[start : start + length])
        units.append(unit + bounds if unit in PREPOSITIONS else unit)
        bounds = ""
        start += length
    return units


def split_bounds(unit: str) -> tuple[str, Bounds | None]:
    """Return a preposition without its distance, and the distance."""
    text, _, marker = unit.partition(_BOUNDS_SIGN)
    return text, bounds_of(marker)


def _begins_preposition(tokens: list[str], start: int) -> bool:
    """Return True if a preposition of several words begins here."""
    compounds = _COMPOUNDS.get(tokens[start], ())
    return any(
        " ".join(unit) in PREPOSITIONS and tuple(tokens[start : start + len(unit)]) == unit for unit in compounds
    )
