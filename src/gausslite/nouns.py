"""Which objects a noun of a task means, and what is known of its kind."""

from __future__ import annotations

import functools
import tomllib
from collections.abc import Iterable
from importlib import resources
from typing import Any, Protocol

from gausslite.plugins import Group, find


class NounVocabulary(Protocol):
    """What a package registers in `gausslite.nouns`: an object or a module that knows more than words.toml."""

    def are_one_kind(self, noun: str, other: str) -> bool:
        """Return True for synonyms, and for a noun and what it is a kind of: "desk" and "table"."""

    def usual_length_m(self, phrase: str) -> float | None:
        """Return the longest side that things of this kind have; None if it is unknown."""


class PlainNouns:
    """The NounVocabulary without such a package: nouns with one head are one kind, and no length is known."""

    def are_one_kind(self, noun: str, other: str) -> bool:
        """Return True if the head nouns are equal."""
        return head_of(noun) == head_of(other)

    def usual_length_m(self, phrase: str) -> None:
        """Return None."""
        del phrase


@functools.cache
def vocabulary() -> NounVocabulary:
    """Return the installed vocabulary, which is chosen once."""
    found: NounVocabulary | None = find(Group.NOUNS)
    return PlainNouns() if found is None else found


@functools.cache
def words() -> dict[str, Any]:
    """Return the tables of `words.toml`: nouns and sizes. The file is read once."""
    return tomllib.loads(resources.files("gausslite").joinpath("words.toml").read_text(encoding="utf-8"))


@functools.cache
def synonyms() -> dict[str, str]:
    """Return the canonical name of each noun that has one."""
    return {name: row[0] for row in words()["nouns"]["synonyms"] for name in row}


def head_of(phrase: str) -> str:
    """Return the head noun: "lawn chair" → "chair", "mug_2" → "mug"."""
    return normalised_noun(phrase).rpartition(" ")[2]


def normalised_noun(phrase: str) -> str:
    """Return the phrase without a trailing number and with plain spaces: "dining_table_1" → "dining table"."""
    parts = phrase.casefold().replace("_", " ").replace("-", " ").split()
    while len(parts) > 1 and parts[-1].isdigit():
        parts.pop()
    return " ".join(parts)


def is_generic(phrase: str) -> bool:
    """Return True if the phrase means any object."""
    return head_of(phrase) in words()["nouns"]["generic"]


def is_structure(phrase: str) -> bool:
    """Return True for parts of a building or of the ground: walls, floors, doors, rooms, roads."""
    return head_of(phrase) in words()["nouns"]["structure"]


def is_convex(phrase: str) -> bool:
    """Return False for a kind of object with other things inside its convex outline: chairs, plants, animals."""
    return head_of(phrase) not in words()["nouns"]["non_convex"]


def same_kind(phrase: str, name: str) -> bool:
    """Return True if a task's phrase means objects of this name: equal heads, or synonyms."""
    if is_generic(phrase):
        return not is_structure(name)
    noun, other = normalised_noun(phrase), normalised_noun(name)
    if head_of(noun) == head_of(other) or vocabulary().are_one_kind(noun, other):
        return True
    canonical = synonyms().get(noun, synonyms().get(head_of(noun)))
    return canonical is not None and canonical == synonyms().get(other, synonyms().get(head_of(other)))


def meant_by(phrase: str, names: Iterable[str]) -> tuple[str, ...]:
    """Return the names of objects that a task's phrase means: those with its head, or its synonyms if there are none.

    "table" means a coffee table and not the counter, but a counter where there is no table; "chair" includes armchairs.
    """
    same = tuple(name for name in names if same_kind(phrase, name))
    head = head_of(normalised_noun(phrase))
    return tuple(name for name in same if head_of(normalised_noun(name)).endswith(head)) or same
