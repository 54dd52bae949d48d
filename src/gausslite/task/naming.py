"""Name the objects of a sentence: one name per noun and attributes, "mug" and "mug_2" (docs/guides/task.md)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from gausslite.domain.task import ObjectAttributes
from gausslite.task.attributes import DescribedNoun, split_attributes


@dataclass(frozen=True, slots=True)
class NamedObjects:
    """The name of each phrase of a sentence, the attributes of the names, and warnings."""

    names: dict[str, str]
    attributes: tuple[ObjectAttributes, ...]
    warnings: tuple[str, ...]


def name_objects(phrases: Iterable[str], excluded: Iterable[str] = ()) -> NamedObjects:
    """Return names for the phrases in their order of mention.

    A phrase without attributes names the latest object of its noun. An excluded phrase always names a new object.
    """
    names: dict[str, str] = {}
    described: dict[str, DescribedNoun] = {}
    referable: dict[str, DescribedNoun] = {}  # in the order of mention
    warnings: list[str] = []
    excluded = set(excluded)
    for phrase in dict.fromkeys(phrases):
        noun = split_attributes(phrase)
        warnings += [f"{word!r} is not understood: every {noun.noun!r} is meant" for word in noun.unseen]
        known = None if phrase in excluded else _known_name(noun, referable)
        number = 1 + sum(each.noun == noun.noun for each in described.values())
        names[phrase] = known or (noun.noun if number == 1 else f"{noun.noun}_{number}")
        described.setdefault(names[phrase], noun)
        if phrase not in excluded:
            referable.setdefault(names[phrase], described[names[phrase]])
    attributes = (ObjectAttributes(name, each.colour, each.superlative) for name, each in described.items())
    return NamedObjects(names, tuple(each for each in attributes if each.colour or each.superlative), tuple(warnings))


def _known_name(noun: DescribedNoun, described: Mapping[str, DescribedNoun]) -> str | None:
    """Return the name of the object with this noun and these attributes; without attributes, the latest of its noun."""
    same_noun = [name for name, each in described.items() if each.noun == noun.noun]
    if noun.colour is None and noun.superlative is None:
        return same_noun[-1] if same_noun else None
    attributes = noun.colour, noun.superlative
    return next(
        (name for name in same_noun if (described[name].colour, described[name].superlative) == attributes), None
    )
