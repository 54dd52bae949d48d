"""Name the objects of a sentence: one name per noun and attributes, "mug" and "mug_2" (docs/tasks.md)."""

from __future__ import annotations

from collections.abc import Iterable
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

    A phrase without attributes names the latest object of its noun; an excluded phrase never names another's object.
    """
    names: dict[str, str] = {}
    described: dict[str, DescribedNoun] = {}
    warnings: list[str] = []
    excluded = set(excluded)
    for phrase in dict.fromkeys(phrases):
        noun = split_attributes(phrase)
        warnings += [f"{word!r} is not understood: every {noun.noun!r} is meant" for word in noun.unseen]
        names[phrase] = _name_of(noun, described, phrase in excluded)
        described.setdefault(names[phrase], noun)
    attributes = (ObjectAttributes(name, each.colour, each.superlative) for name, each in described.items())
    return NamedObjects(names, tuple(each for each in attributes if each.colour or each.superlative), tuple(warnings))


def _name_of(noun: DescribedNoun, described: dict[str, DescribedNoun], is_excluded: bool) -> str:
    same_noun = [name for name, each in described.items() if each.noun == noun.noun]
    is_plain = noun.colour is None and noun.superlative is None
    if is_plain and same_noun and not is_excluded:
        return same_noun[-1]
    for name in same_noun:
        known = described[name]
        if not is_excluded and (known.colour, known.superlative) == (noun.colour, noun.superlative):
            return name
    return f"{noun.noun}_{len(same_noun) + 1}" if same_noun else noun.noun
