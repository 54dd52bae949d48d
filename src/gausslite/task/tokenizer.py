"""Split a sentence into words, with multi-word prepositions and negations as one unit: "next to", "do not"."""

from __future__ import annotations

import re
from typing import Final

from gausslite.task import lexicon
from gausslite.task.idioms import replace_idioms
from gausslite.task.prepositions import PREPOSITIONS

_TOKEN: Final = re.compile(r"[^\W\d_][\w'’-]*|\d[\w.]*|[,/&+;.!?:()]")
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
    while start < len(tokens):
        compounds = _COMPOUNDS.get(tokens[start], ())
        length = next((len(unit) for unit in compounds if tuple(tokens[start : start + len(unit)]) == unit), 1)
        units.append(" ".join(tokens[start : start + length]))
        start += length
    return units
