"""Find distances such as "within 2 m of" and "half a metre behind", and replace each by one marker word."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Final

_NUMBERS: Final = {
    "a quarter of a": 0.25, "half a": 0.5, "half an": 0.5, "half": 0.5, "a couple of": 2.0, "a": 1.0, "an": 1.0,
    "one": 1.0, "two": 2.0, "three": 3.0, "four": 4.0, "five": 5.0, "six": 6.0, "seven": 7.0, "eight": 8.0,
    "nine": 9.0, "ten": 10.0, "twelve": 12.0, "fifteen": 15.0, "twenty": 20.0,
}  # fmt: skip
# metres by the first letters of a unit
_UNITS_M: Final = (
    ("centi", 0.01), ("cm", 0.01), ("milli", 0.001), ("mm", 0.001), ("f", 0.3048), ("in", 0.0254), ("y", 0.9144),
    ("step", 0.75), ("pace", 0.75), ("m", 1.0),
)  # fmt: skip
_VALUE: Final = rf"(?:\d{{1,4}}(?:[.,]\d{{1,3}})?|{'|'.join(sorted(_NUMBERS, key=len, reverse=True))})(?: and a half)?"
_UNIT: Final = (
    r"(?:centimet(?:er|re)s?|cms?|millimet(?:er|re)s?|mm|met(?:er|re)s?|m|feet|foot|ft|inch(?:es)?|yards?|paces?|"
    r"steps?)"
)
_MAX: Final = (
    r"within|inside|less than|at most|up to|under|below|a maximum of|max(?:imum)?|(?:closer|nearer) than|"
    r"(?:no|not) (?:more|further|farther|greater)(?: away)? than|not over|(?:no|not) beyond"
)
_MIN: Final = (
    r"at least|more than|over|above|beyond|a minimum of|min(?:imum)?|(?:further|farther)(?: away)? than|"
    r"outside(?: of)?|"
    r"(?:no|not) (?:less|closer|nearer)(?: away)? than"
)
_ABOUT: Final = r"about|around|roughly|approximately|approx|some|exactly|nearly|almost|just|only|circa"
# other prepositions that a distance can bound
_BOUNDED: Final = r"behind|in front|left|right|to the|above|below|under|underneath|beneath|over|inside|on the"
_DISTANCE: Final = re.compile(
    rf"\b(?:at a distance of )?(?:(?P<max>{_MAX})|(?P<min>{_MIN}))?(?: ?\b(?:{_ABOUT}))? ?"
    rf"(?:\bbetween )?\b(?:(?P<low>{_VALUE})(?: ?{_UNIT})?(?: ?- ?| to | and | or ))?(?P<value>{_VALUE}) ?{_UNIT}\b"
    rf"(?P<half> and a half)?(?: or (?P<or>less|more))?(?: (?:away|apart|off|distant))?"
    rf"(?: (?P<link>from|of|to)\b(?! the (?:left|right))|(?= (?:{_BOUNDED})\b))"
)
_UNIT_AFTER: Final = re.compile(rf"{_VALUE} ?(?P<unit>{_UNIT})\b")
_VAGUE: Final = re.compile(
    r"\b(?:a few|several|some|many|various|a number of) (?:met(?:er|re)s?|feet|steps?|paces?|yards?|inch(?:es)?|"
    r"centimet(?:er|re)s?)(?: away)? from\b|\b(?:at )?(?:some|a|a certain|a short|a safe|a little) "
    r"(?:distance|way)(?: away)? from\b"
)
# after a number or a unit, a minus sign is a range: "2 -3 m"
_NEGATIVE: Final = re.compile(
    rf"(?:\b(?:{_MAX}|{_MIN}|{_ABOUT}) )*(?:(?<![\w])(?<![\dm] )[-\u2212](?=\d)|\bminus ){_VALUE} ?{_UNIT}\b"
    rf"(?: (?:away|apart|off|distant))?(?: (?:of|from|to)\b)?"
)
_MARKER: Final = re.compile(r"(at|bound)distance_(x|\d+)_(x|\d+)")
VAGUE_MARKER: Final = "vaguedistance"


@dataclass(frozen=True, slots=True)
class Bounds:
    """Bounds of a distance; None where there is none. stands_alone: the marker is a preposition itself, "2 m from"."""

    min_m: float | None = None
    max_m: float | None = None
    stands_alone: bool = False


UNBOUNDED: Final = Bounds()


def mark_distances(text: str) -> str:
    """Return the text with every distance to something replaced by a marker word.

    A negative distance, which nothing has, becomes the marker of a distance without a number.
    """
    return _DISTANCE.sub(_marker, _NEGATIVE.sub(f" {VAGUE_MARKER} ", _VAGUE.sub(f" {VAGUE_MARKER} ", text)))


def bounds_of(marker: str) -> Bounds | None:
    """Return the bounds of a marker word; None for other words."""
    match = _MARKER.fullmatch(marker)
    if match is None:
        return None
    low_m, high_m = (None if text == "x" else int(text) / 100 for text in match.groups()[1:])
    return Bounds(low_m, high_m, match[1] == "at")


def _marker(match: re.Match[str]) -> str:
    link, bounded = match["link"], match["max"] or match["min"] or ""
    if (link == "of" and not bounded.startswith(("within", "inside", "outside"))) or (
        link == "to" and "er than" not in bounded
    ):
        return match[0]
    unit = _UNIT_AFTER.search(match[0], match.start("value") - match.start())
    scale_m = next(metres for start, metres in _UNITS_M if unit is not None and unit["unit"].startswith(start))
    value_m = (_number(match["value"]) + 0.5 * (match["half"] is not None)) * scale_m
    low_m = value_m if match["low"] is None else _number(match["low"]) * scale_m
    is_max = match["max"] is not None or match["or"] == "less"
    is_min = match["min"] is not None or match["or"] == "more"
    low = "x" if is_max else f"{100 * low_m:.0f}"
    high = "x" if is_min else f"{100 * value_m:.0f}"
    return f" {'at' if link else 'bound'}distance_{low}_{high} "


def _number(text: str) -> float:
    whole, and_a_half, _ = text.partition(" and a half")
    value = _NUMBERS[whole] if whole in _NUMBERS else float(whole.replace(",", "."))
    return value + 0.5 * bool(and_a_half)
