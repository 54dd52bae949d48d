"""Part-of-speech tags, and the tag sequence of least cost for a sentence (Viterbi)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from enum import Enum
from typing import Final


class Tag(Enum):
    """Parts of speech that the task parser distinguishes.

    PARTICLE: the "up" of "pick up". INFINITIVE: "to". CLAUSE_BREAK: punctuation and words that start a clause.
    INDEFINITE: "something", "who". ANAPHOR: "it", "this" without a noun.
    """

    NOUN = "n"
    ADJECTIVE = "a"
    DETERMINER = "d"
    VERB = "v"
    GERUND = "g"
    PARTICIPLE = "e"
    AUXILIARY = "x"
    PREPOSITION = "p"
    PARTICLE = "t"
    INFINITIVE = "u"
    CONJUNCTION = "c"
    CLAUSE_BREAK = "s"
    RELATIVE = "w"
    PRONOUN = "o"
    INDEFINITE = "i"
    ANAPHOR = "k"
    NEGATION = "q"

    __hash__ = object.__hash__  # members are singletons, and Enum's own hash is slow


# Cost of one tag (column) after another (row); "^" is the start and "." the end of the sentence. Chosen by hand:
# 0 is frequent in English, 10 is occasional, 90 does not occur.
_COSTS: Final = """
   n  a  d  v  g  e  x  p  t  u  c  s  w  o  i  k  q  .
^ 10 10  0  0 10 30  0 10 20 10 20 10 10  0  0 10  0  5
n  8 20 30 20 10 10  5  0  5  5  0  0  0 20 30 30  0  0
a  0  3 40 40  8 10 20  7 15 10  5  7 20 30 40 40 20  7
d  0  0  5 90  7  7 60 20 60 30 30 30 40 50 40 60 40 20
v  5  5  0 30  8 30 40  0  0  5  5  5 20  0  0  0 10  5
g  7  7  0 50 30 30 30  0  0 10 10 10 20  5  3  0 20  5
e  7  7  7 50 30 30 40  0  3 10  7  7 20 10 10 10 10  3
x  5  0  0  0  0  0  5  0  5  0 20 20 20  0  0  0  0 10
p  0  0  0 90 10 20 60 30 30 50 30 30 10  0  0  0 20 20
t 10 10  0 30 30 30 20  0 10  5  0  0 20 10 10 20 10  0
u 90 90 90  0 50 90  0 90 90 90 90 90 90 90 90 90 10 90
c  5  5  0  5  7 15  5  5 20  5  0  0  5  3  5 10  0 10
s  8  8  0  3  5 15  5  5 30 10  0  0  5  0  0 10  0  0
w 25 15  0  0 30  7  0 20 40  5 20 20 20  0  3  0 10 20
o 20 20 15  0 10  3  0  0  0  0  0  0 20 15 10 20  0  0
i 40 20 30 10  7  5  0  0  5  3  0  0  0 10 40 40  0  0
k 40 20 30 20 20 20  5  0  5  5  0  0 10 40 40 40 10  0
q  5  5  0  0  0 10 10 10 30  5 20 20 20  5  0  0 20 20
"""


def _table(text: str) -> dict[Tag | None, dict[Tag | None, int]]:
    """Return the costs by row and column tag; None is the start as a row and the end as a column."""
    header, *rows = [line.split() for line in text.strip().splitlines()]
    columns = [None if name == "." else Tag(name) for name in header]
    return {None if row[0] == "^" else Tag(row[0]): dict(zip(columns, map(int, row[1:]), strict=True)) for row in rows}


TRANSITION_COSTS: Final = _table(_COSTS)


def best_tags(candidates: Sequence[Mapping[Tag, int]]) -> list[Tag]:
    """Return one tag per word that minimises the sum of word costs and transition costs (Viterbi)."""
    paths: dict[Tag | None, int] = {None: 0}
    backpointers: list[dict[Tag, Tag | None]] = []
    for options in candidates:
        reached: dict[Tag | None, int] = {}
        origins: dict[Tag, Tag | None] = {}
        for tag, own_cost in options.items():
            cost, origin = min(
                ((path_cost + TRANSITION_COSTS[before][tag], before) for before, path_cost in paths.items()), key=_cost
            )
            reached[tag], origins[tag] = cost + own_cost, origin
        paths = reached
        backpointers.append(origins)
    last = min(paths, key=lambda tag: paths[tag] + TRANSITION_COSTS[tag][None])
    found: list[Tag] = []
    for origins in reversed(backpointers):
        if last is not None:
            found.append(last)
            last = origins[last]
    return found[::-1]


def _cost(pair: tuple[int, Tag | None]) -> int:
    return pair[0]
