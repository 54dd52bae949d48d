"""Name the colours of observed pixels, and decide whether an object can have the colour that a task says.

Colours are compared in Oklab (Ottosson, 2020). There, a change of brightness scales lightness and chroma alike, so hue
and the ratio of chroma to lightness do not depend on shading. Each pixel falls into a range of colours with the basic
terms (Berlin and Kay, 1969) that name it, and those that could name it: in warm light, white is beige.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Final, NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float64, UInt8
from numpy import ndarray

from gausslite.domain.frame import Frame
from gausslite.domain.task import TaskGraph, noun_of
from gausslite.perception.selector import Fit
from gausslite_selection.words import words

_MIN_NAMED_SHARE = 0.3
"""From this share in ranges that a word names, the object is of the colour."""
_MIN_POSSIBLE_SHARE = 0.12
"""Below this share in ranges that a word could name, it is not."""

_MIN_INNER_PIXELS = 20
"""Pixels inside the outline from which they alone give an object's colours."""
_MAX_COLOUR_PIXELS = 500
_ANY: Final = (-np.inf, np.inf)


class _Range(NamedTuple):
    """A range of hue in degrees, of saturation and of lightness, and the terms that name or could name it."""

    limits: tuple[tuple[float, float], ...]
    named: frozenset[str]
    possible: frozenset[str]


@functools.cache
def _ranges() -> tuple[_Range, ...]:
    """Return the ranges of colours; the first one that a pixel falls into counts."""
    return tuple(
        _Range(
            tuple(tuple(row.get(axis, _ANY)) for axis in ("hue_deg", "saturation", "lightness")),
            frozenset([row["named"]] if "named" in row else []),
            frozenset(row["possible"]),
        )
        for row in words()["colours"]["ranges"]
    )


def basic_terms() -> tuple[str, ...]:
    """Return the basic colour terms."""
    return tuple(words()["colours"]["terms"])


# linear sRGB to the cones' responses, and their cube roots to Oklab
_CONES_OF_RGB: Final = np.array(
    [
        [0.4122214708, 0.5363325363, 0.0514459929],
        [0.2119034982, 0.6806995451, 0.1073969566],
        [0.0883024619, 0.2817188376, 0.6299787005],
    ]
)
_OKLAB_OF_CONES: Final = np.array(
    [
        [0.2104542553, 0.7936177850, -0.0040720468],
        [1.9779984951, -2.4285922050, 0.4505937099],
        [0.0259040371, 0.7827717662, -0.8086757660],
    ]
)


def colour_counts(rgb: UInt8[ndarray, "n 3"]) -> Float64[ndarray, "balances ranges"]:
    """Return the share of the pixels in each range of colours, for each white balance; zeros without pixels."""
    return np.stack([_range_shares(rgb.astype(np.float64) * gains) for gains in words()["colours"]["white_balances"]])


def mask_colours(mask: Bool[ndarray, "h w"], frame: Frame) -> Float64[ndarray, "balances ranges"]:
    """Return the `colour_counts` of a mask's pixels, without its outline, which mixes with what is behind."""
    inner = cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    pixels = frame.rgb[inner if np.count_nonzero(inner) >= _MIN_INNER_PIXELS else mask]
    return colour_counts(pixels[:: max(1, len(pixels) // _MAX_COLOUR_PIXELS)])


def no_colours() -> Float64[ndarray, "balances ranges"]:
    """Return the counts of an object without pixels."""
    return np.zeros((len(words()["colours"]["white_balances"]), len(_ranges())))


def is_evaluated(colour: str) -> bool:
    """Return True if the words of a task's colour are known, such as "red", "light blue" or "black and white"."""
    return all(_terms_of(word) for word in colour.split(" and "))


def match_colour(colour: str, counts: Float64[ndarray, "balances ranges"]) -> Fit:
    """Return whether an object with these sums of `colour_counts` has the colour.

    YES: ranges that the word names have 0.3 of the pixels, as the camera shows them. NO: ranges that it could name have
    less than 0.12 with every white balance. "black and white" needs both. DOUBTFUL otherwise, for unknown words, and
    without pixels.
    """
    total = float(counts[0].sum())
    if total == 0.0 or not is_evaluated(colour):
        return Fit.DOUBTFUL
    matches = [_match_terms(_terms_of(word), counts / total) for word in colour.split(" and ")]
    if Fit.NO in matches:
        return Fit.NO
    return Fit.YES if all(match is Fit.YES for match in matches) else Fit.DOUBTFUL


def _match_terms(terms: frozenset[str], shares: Float64[ndarray, "balances ranges"]) -> Fit:
    is_named = np.array([not terms.isdisjoint(colours.named) for colours in _ranges()])
    if float(shares[0, is_named].sum()) >= _MIN_NAMED_SHARE:
        return Fit.YES
    is_possible = np.array([not terms.isdisjoint(colours.possible) for colours in _ranges()])
    possible = float(shares[:, is_possible].sum(axis=1).max())
    return Fit.NO if possible < _MIN_POSSIBLE_SHARE else Fit.DOUBTFUL


def _terms_of(word: str) -> frozenset[str]:
    """Return the basic terms that a word may mean, without its shade: "light blue" → blue; none for unknown words."""
    colours = words()["colours"]
    base = " ".join(part for part in word.split() if part not in colours["shades"])
    return frozenset([base] if base in colours["terms"] else colours["words"].get(base, ()))


def _range_shares(rgb: Float64[ndarray, "n 3"]) -> Float64[ndarray, " ranges"]:
    lightness, hue_deg, saturation = _oklab(rgb)
    values = (hue_deg, saturation, lightness)
    is_free = np.ones(len(rgb), np.bool_)
    shares = np.zeros(len(_ranges()))
    for index, colours in enumerate(_ranges()):
        is_inside = is_free.copy()
        for value, (low, high) in zip(values, colours.limits, strict=True):
            is_inside &= (value >= low) & (value < high)
        shares[index] = np.count_nonzero(is_inside)
        is_free &= ~is_inside
    return shares / max(len(rgb), 1)


def linear_light(encoded: Float[ndarray, "n 3"]) -> Float[ndarray, "n 3"]:
    """Return sRGB colours in [0, 1] as linear light in [0, 1], in the same precision (IEC 61966-2-1)."""
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


def _oklab(
    rgb: Float64[ndarray, "n 3"],
) -> tuple[Float64[ndarray, " n"], Float64[ndarray, " n"], Float64[ndarray, " n"]]:
    """Return lightness, hue in degrees from -20 to 340, and saturation: the ratio of chroma to lightness."""
    linear = linear_light(np.minimum(rgb / 255.0, 1.0))
    lightness, a, b = (np.cbrt(linear @ _CONES_OF_RGB.T) @ _OKLAB_OF_CONES.T).T
    hue_deg = (np.degrees(np.arctan2(b, a)) + 20.0) % 360.0 - 20.0
    return lightness, hue_deg, np.hypot(a, b) / np.maximum(lightness, 1e-6)


class ColourFilter:
    """The colours of a task's names. An object whose colour clearly differs is not meant; a doubtful one is."""

    def __init__(self, graph: TaskGraph) -> None:
        self._colours = {
            attributes.name: attributes.colour for attributes in graph.attributes if attributes.colour is not None
        }
        named = {noun_of(target) for target in graph.targets}
        excluded = [name for name in graph.excluded if name in self._colours]
        self._excluded = tuple((noun_of(name), self._colours[name]) for name in excluded if noun_of(name) in named)
        self._excluded_everywhere = tuple(name for name in excluded if noun_of(name) not in named)
        self._names = tuple(name for name in self._colours if name not in graph.excluded)

    def match(self, name: str, counts: Float64[ndarray, "balances ranges"]) -> Fit:
        """Return whether an object with these counts has the colour of a name; YES for a name without a colour."""
        colour = self._colours.get(name)
        return Fit.YES if colour is None else match_colour(colour, counts)

    def allows(self, name: str, counts: Float64[ndarray, "balances ranges"]) -> bool:
        """Return False if the colour of an object clearly differs from that of a name."""
        return self.match(name, counts) is not Fit.NO

    def is_excluded(self, noun: str, counts: Float64[ndarray, "balances ranges"]) -> bool:
        """Return True if an object of a target's noun clearly has the colour of an excluded object of this noun."""
        return any(noun == excluded and match_colour(colour, counts) is Fit.YES for excluded, colour in self._excluded)

    def label(self, name: str) -> str:
        """Return the noun of a name with its colour."""
        return " ".join(filter(None, (self._colours.get(name), noun_of(name))))

    def notes(self, seen: Sequence[tuple[str, Float64[ndarray, "balances ranges"]]]) -> tuple[str, ...]:
        """Return a line for each colour that was doubtful or left objects out; seen: their nouns and counts."""
        lines = [self._describe(name, seen) for name in self._names]
        for noun, colour in self._excluded:
            matches = [match_colour(colour, counts) for other, counts in seen if other == noun]
            doubtful = matches.count(Fit.DOUBTFUL)
            if doubtful:
                lines.append(f"excluded {colour} {noun!r}: {doubtful} of {len(matches)} objects may be one, and count")
        lines += [
            f"excluded {self.label(name)!r}: its colour is not evaluated, every {noun_of(name)!r} is left out"
            for name in self._excluded_everywhere
        ]
        return tuple(line for line in lines if line)

    def _describe(self, name: str, seen: Sequence[tuple[str, Float64[ndarray, "balances ranges"]]]) -> str:
        colour, noun = self._colours[name], noun_of(name)
        if not is_evaluated(colour):
            return f"{colour} {noun!r}: this colour is not evaluated, every {noun!r} counts"
        matches = [self.match(name, counts) for other, counts in seen if other == noun]
        other, doubtful = matches.count(Fit.NO), matches.count(Fit.DOUBTFUL)
        parts = []
        if other:
            parts.append(f"{other} of {len(matches)} objects of another colour do not count")
        if doubtful:
            parts.append(f"{doubtful} of {len(matches)} objects of doubtful colour count")
        return f"{colour} {noun!r}: {', '.join(parts)}" if parts else ""
