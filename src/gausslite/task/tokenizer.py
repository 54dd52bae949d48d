"""Cut a sentence into words, keeping together what English reads as one: "next to", "do not"."""

from __future__ import annotations

import re
from typing import Final

from gausslite.task import lexicon
from gausslite.task.idioms import replace_idioms
from gausslite.task.prepositions import PREPOSITIONS

_TOKEN: Final = re.compile(r"[^\W\d_][\w'’-]*|\d[\w.]*|[,/&+;.!?:()]")
_UNITS: Final = [
    *(tuple(said.split()) for said in PREPOSITIONS if " " in said),
    *(negation for negation in lexicon.NEGATIONS if len(negation) > 1),
]
# by their first word, the longest first
_COMPOUNDS: Final = {
    first: sorted((unit for unit in _UNITS if unit[0] == first), key=len, reverse=True)
    for first in {unit[0] for unit in _UNITS}
}


def tokenize(text: str) -> list[str]:
    """Lower-case words, numbers and the punctuation that matters."""
    return _TOKEN.findall(replace_idioms(text))


def lexical_units(text: str) -> list[str]:
    """The tokens of a text, with prepositions and negations of several words as one unit each."""
    tokens = tokenize(text)
    units: list[str] = []
    at = 0
    while at < len(tokens):
        length = next(
            (len(unit) for unit in _COMPOUNDS.get(tokens[at], ()) if tuple(tokens[at : at + len(unit)]) == unit), 1
        )
        units.append(" ".join(tokens[at : at + length]))
        at += length
    return units
