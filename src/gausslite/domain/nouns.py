"""The vocabulary of nouns: which words name things, and which class of a detector a noun is, by WordNet's hypernyms."""

from __future__ import annotations

import functools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from importlib import resources
from typing import Final

_MAX_STEPS: Final = 3
# a class with more kinds than this is no other name of each of them: "container", "tool", "food"
_MAX_KINDS: Final = 150
_COLLECTIVE_ENDINGS: Final = ("ry", "ware", "s")


@dataclass(frozen=True, slots=True)
class Vocabulary:
    """Sets of synonyms: `senses` has the sets of each noun, its main meaning first; `above` their hypernyms."""

    senses: dict[str, tuple[int, ...]]
    above: tuple[tuple[int, ...], ...]
    kinds: tuple[int, ...]
    """Number of sets below each set."""

    def main(self, noun: str) -> int | None:
        """Return the set of the noun's main meaning; None for an unknown noun."""
        return self.senses[noun][0] if noun in self.senses else None

    def steps(self, low: int | None, high: int | None) -> int | None:
        """Return how many hypernyms lead from one set up to another; None if none or more than three do."""
        if low is None or high is None:
            return None
        reached = {low}
        for steps in range(_MAX_STEPS + 1):
            if high in reached:
                return steps
            reached = {parent for at in reached for parent in self.above[at]}
        return None


@functools.cache
def vocabulary() -> Vocabulary:
    """Return the nouns of `nouns.txt`. The file is read once."""
    text = resources.files("gausslite.domain").joinpath("nouns.txt").read_text(encoding="utf-8")
    main: dict[str, tuple[int, ...]] = {}
    other: dict[str, tuple[int, ...]] = {}
    above: list[tuple[int, ...]] = []
    for line in text.splitlines():
        if line.startswith("#"):
            continue
        parents, _, words = line.partition("|")
        for word in words.split(",") if words else ():
            senses = other if word.endswith("*") else main
            noun = word.rstrip("*").replace("-", " ")
            senses[noun] = (*senses.get(noun, ()), len(above))
        above.append(tuple(map(int, parents.split())))
    kinds = [0] * len(above)
    for at in range(len(above) - 1, -1, -1):  # hypernyms come first
        for parent in above[at]:
            kinds[parent] += 1 + kinds[at]
    senses = {noun: (*main.get(noun, ()), *other.get(noun, ())) for noun in {**main, **other}}
    return Vocabulary(senses, tuple(above), tuple(kinds))


def is_thing(noun: str) -> bool:
    """Return True if the noun names something that can be seen."""
    return noun in vocabulary().senses


def are_synonyms(noun: str, other: str) -> bool:
    """Return True if the main meanings of two nouns are one."""
    known = vocabulary()
    sense = known.main(noun)
    return sense is not None and sense == known.main(other)


def classes_of(noun: str, class_names: Iterable[str]) -> tuple[str, ...]:
    """Return the lower-case class names that mean the noun: its synonyms, else its kinds, else what it is a kind of.

    A compound is a kind of its head: "computer monitor" is a monitor, "waste container" is the class of a trash can.
    """
    names = tuple(class_names)
    for matches in (_is_synonym, _is_kind, _is_above):
        found = {name: steps for name in names if (steps := matches(noun, name)) is not None}
        if found:
            nearest = min(found.values()) if matches is _is_above else _MAX_STEPS
            return tuple(name for name, steps in found.items() if steps <= nearest)
    return ()


def _is_synonym(noun: str, name: str) -> int | None:
    same = are_synonyms(noun, name) or any(name == noun + ending for ending in _COLLECTIVE_ENDINGS)
    return 0 if same or _same_compound(noun, name) else None


def _is_kind(noun: str, name: str) -> int | None:
    """Return the steps from the class up to the noun."""
    known = vocabulary()
    if name.endswith(f" {noun}"):
        return 1
    steps = known.steps(known.main(name), known.main(noun))
    return steps if steps and known.kinds[known.senses[noun][0]] <= _MAX_KINDS else None


def _is_above(noun: str, name: str) -> int | None:
    """Return the steps from the noun up to the class."""
    known = vocabulary()
    steps = known.steps(known.main(noun), known.main(name))
    return steps if steps and known.kinds[known.senses[name][0]] <= _MAX_KINDS else None


def _same_compound(noun: str, name: str) -> bool:
    """Return True if the class has two words, and each is the noun's or above it: "trash can", "waste container"."""
    ours, theirs = noun.split(), name.split()
    if len(ours) != 2 or len(theirs) != 2:
        return False
    known = vocabulary()
    kind, made_of = known.main(noun), known.main(ours[0])
    is_head = ours[1] == theirs[1] or known.steps(kind, known.main(theirs[1])) is not None
    return is_head and (ours[0] == theirs[0] or known.steps(made_of, known.main(theirs[0])) is not None)


def nearest_names(noun: str, class_names: Sequence[str], count: int = 3) -> tuple[str, ...]:
    """Return the class names that share the nearest hypernym with a noun; empty for an unknown noun."""
    known = vocabulary()
    ours = _all_above(known, known.main(noun))
    shared: list[tuple[int, str]] = []
    for name in class_names:
        common = ours.keys() & _all_above(known, known.main(name.casefold())).keys()
        if common:
            shared.append((min(ours[at] + _all_above(known, known.main(name.casefold()))[at] for at in common), name))
    return tuple(name for steps, name in sorted(shared)[:count] if steps <= 2 * _MAX_STEPS)


def _all_above(known: Vocabulary, sense: int | None) -> dict[int, int]:
    """Return every hypernym of a set with its steps."""
    found: dict[int, int] = {}
    reached, steps = ({sense} if sense is not None else set()), 0
    while reached:
        found.update({at: steps for at in reached if at not in found})
        reached, steps = {parent for at in reached for parent in known.above[at]}, steps + 1
    return found
