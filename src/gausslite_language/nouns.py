"""Know nouns: which words name things, of which kinds by WordNet's hypernyms, and how long such things are.

The module is the `NounVocabulary` that the core finds.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from importlib import resources
from typing import Final

from gausslite.nouns import head_of, normalised_noun, synonyms

_MAX_STEPS: Final = 3
# a class with more kinds than this is no other name of each of them: "container", "kitchen utensil", "tool"
_MAX_KINDS: Final = 60
# one class stands for a noun with at most this many kinds: "computer monitor" for a monitor, no sandal for a shoe
_KINDS_PER_CLASS: Final = 10
# a shared hypernym of more kinds makes no two things near: furniture has 189, "device" 2715
_MAX_NEAR_KINDS: Final = 200
_COLLECTIVE_ENDINGS: Final = ("ry", "ware", "s")


@dataclass(frozen=True, slots=True)
class Vocabulary:
    """Sets of synonyms: `senses` has the sets of each noun, its main meaning first; `above` their hypernyms."""

    senses: dict[str, tuple[int, ...]]
    above: tuple[tuple[int, ...], ...]
    kinds: tuple[int, ...]
    """Number of sets below each set."""
    doubtful: frozenset[str]
    """The nouns whose main meaning is not here: a poster is no post horse."""

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
    text = resources.files("gausslite_language").joinpath("nouns.txt").read_text(encoding="utf-8")
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
    return Vocabulary(senses, tuple(above), tuple(kinds), frozenset(other.keys() - main.keys()))


def is_thing(noun: str) -> bool:
    """Return True if the noun names something that can be seen."""
    return noun in vocabulary().senses


def are_synonyms(noun: str, other: str) -> bool:
    """Return True if the main meanings of two nouns are one."""
    known = vocabulary()
    sense = known.main(noun)
    return sense is not None and sense == known.main(other)


def is_kind_of(noun: str, other: str) -> bool:
    """Return True if a noun's hypernyms lead to any meaning of another noun: a "coffee mug" is a "mug"."""
    known = vocabulary()
    return any(known.steps(known.main(noun), sense) is not None for sense in known.senses.get(other, ()))


def are_one_kind(noun: str, other: str) -> bool:
    """Return True for synonyms, and if one noun is a kind of the other and that has few kinds: "desk" and "table"."""
    return (
        noun == other
        or are_synonyms(noun, other)
        or bool(nearest_above(noun, (other,)) or nearest_above(other, (noun,)))
    )


def synonymous_classes(noun: str, class_names: Iterable[str]) -> tuple[str, ...]:
    """Return the lower-case class names that are other words for the noun: "tap" for a faucet, "cabinetry".

    A compound may also be the noun's words in general: "waste container" for a "trash can".
    """
    collective = tuple(noun + ending for ending in _COLLECTIVE_ENDINGS)
    return tuple(
        name for name in class_names if are_synonyms(noun, name) or name in collective or _same_compound(noun, name)
    )


def kinds_of(noun: str, class_names: Iterable[str]) -> tuple[str, ...]:
    """Return the lower-case class names that are the noun or kinds of it."""
    known = vocabulary()
    ours = known.main(noun)
    return tuple(
        name
        for name in class_names
        if name == noun
        or (name not in known.doubtful and known.steps(known.main(name), ours))
        or _is_compound_of(name, noun)
    )


def kinds_among(noun: str, class_names: Iterable[str]) -> tuple[str, ...]:
    """Return `kinds_of`, which stand for the noun, unless they are few of its many kinds."""
    known, found = vocabulary(), kinds_of(noun, class_names)
    ours = known.main(noun)
    return found if ours is None or known.kinds[ours] <= _KINDS_PER_CLASS * len(found) else ()


def _is_compound_of(name: str, noun: str) -> bool:
    """Return True if a name ends with the noun, and WordNet has it as a kind of the noun, or does not have it."""
    before = name.removesuffix(noun)
    if before == name or is_thing(name):
        return before != name and is_kind_of(name, noun)
    return before.endswith(" ") or is_thing(before)


def nearest_above(noun: str, class_names: Iterable[str]) -> tuple[str, ...]:
    """Return the lower-case class name that the noun is a kind of, the nearest; empty for classes of many kinds."""
    known = vocabulary()
    above = {}
    for name in class_names:
        sense = known.main(name)
        steps = known.steps(known.main(noun), sense)
        if sense is not None and steps is not None and known.kinds[sense] <= _MAX_KINDS:
            above[name] = steps
    nearest = min(above.values(), default=None)
    return tuple(name for name, steps in above.items() if steps == nearest)


@functools.cache
def _other_words(noun: str) -> tuple[str, ...]:
    """Return all words of a noun's main meaning."""
    known = vocabulary()
    sense = known.main(noun)
    return tuple(word for word, senses in known.senses.items() if senses[0] == sense) or (noun,)


def _same_compound(noun: str, name: str) -> bool:
    """Return True if the class has two words, and both words of the noun or of a synonym are kinds of them."""
    if name.count(" ") != 1:
        return False
    modifier, head = name.split()
    return any(
        word.count(" ") == 1 and is_kind_of(word, head) and _may_be_kind(word.split()[0], modifier)
        for word in _other_words(noun)
    )


def _may_be_kind(noun: str, other: str) -> bool:
    known = vocabulary()
    senses = known.senses.get(noun, ())
    return noun == other or any(
        known.steps(low, high) is not None for low in senses for high in known.senses.get(other, ())
    )


def nearest_names(noun: str, class_names: Sequence[str], count: int = 3) -> tuple[str, ...]:
    """Return the class names that share the nearest hypernym of few kinds with a noun; empty for an unknown noun."""
    known = vocabulary()
    ours = _all_above(known, known.main(noun))
    shared: list[tuple[int, str]] = []
    for name in class_names:
        common = ours.keys() & _all_above(known, known.main(name.casefold())).keys()
        common = {at for at in common if known.kinds[at] <= _MAX_NEAR_KINDS}
        if common:
            shared.append((min(ours[at] + _all_above(known, known.main(name.casefold()))[at] for at in common), name))
    return tuple(name for steps, name in sorted(shared)[:count] if steps <= 1 + _MAX_STEPS)


def _all_above(known: Vocabulary, sense: int | None) -> dict[int, int]:
    """Return every hypernym of a set with its steps."""
    found: dict[int, int] = {}
    reached, steps = ({sense} if sense is not None else set()), 0
    while reached:
        found.update({at: steps for at in reached if at not in found})
        reached, steps = {parent for at in reached for parent in known.above[at]}, steps + 1
    return found


@functools.cache
def lengths_m() -> dict[str, float]:
    """Return the longest side of each kind in `sizes.txt`. The file is read once."""
    text = resources.files("gausslite_language").joinpath("sizes.txt").read_text(encoding="utf-8")
    rows = (line.split("|") for line in text.splitlines() if not line.startswith("#"))
    return {_as_one_word(kind): float(length_m) for kind, length_m in rows}


def _as_one_word(kind: str) -> str:
    """Return "houseplant" for "house plant" if only that is a noun."""
    joined = kind.replace(" ", "")
    return joined if is_thing(joined) and not is_thing(kind) else kind


@functools.cache
def usual_length_m(phrase: str) -> float | None:
    """Return the longest side that things of this kind have; None if it is unknown.

    The kind, its synonyms and its kinds count; without any of them what it is a kind of.
    """
    known = lengths_m()
    for noun in dict.fromkeys((normalised_noun(phrase), head_of(phrase))):
        row = {noun, *(name for name in known if noun in synonyms() and synonyms().get(name) == synonyms()[noun])}
        if kinds := {*row & known.keys(), *synonymous_classes(noun, known), *kinds_among(noun, known)}:
            return max(known[kind] for kind in kinds)
        if above := nearest_above(noun, known):
            return usual_length_m(above[0])
    return None
