"""Name the colours of observed pixels, and decide whether an object can have the colour that a task says.

Colours are compared in Oklab (Ottosson, 2020). There, a change of brightness scales lightness and chroma alike, so hue
and the ratio of chroma to lightness do not depend on shading. Each pixel falls into a range of colours with the basic
terms (Berlin and Kay, 1969) that name it, and those that could name it: in warm light, white is beige.
"""

from __future__ import annotations

from enum import Enum
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, UInt8
from numpy import ndarray

from gausslite.domain.srgb import linear_light

BASIC_TERMS: Final = ("black", "grey", "white", "red", "orange", "yellow", "green", "blue", "purple", "pink", "brown")

# other words, by the terms that they may mean
_TERMS_OF_WORD: Final[dict[str, tuple[str, ...]]] = {
    **{term: (term,) for term in BASIC_TERMS},
    "beige": ("white", "yellow", "brown"),
    "cream": ("white", "yellow"),
    "ivory": ("white", "yellow"),
    "tan": ("brown", "yellow", "orange"),
    "khaki": ("brown", "yellow", "green"),
    "amber": ("orange", "yellow", "brown"),
    "bronze": ("brown", "orange", "yellow"),
    "gold": ("yellow", "orange", "brown"),
    "golden": ("yellow", "orange", "brown"),
    "silver": ("grey", "white"),
    "turquoise": ("green", "blue"),
    "teal": ("green", "blue"),
    "cyan": ("blue", "green"),
    "navy": ("blue", "black"),
    "indigo": ("blue", "purple"),
    "violet": ("purple",),
    "lilac": ("purple", "pink"),
    "magenta": ("pink", "purple"),
    "maroon": ("red", "brown"),
    "crimson": ("red",),
    "scarlet": ("red", "orange"),
}
_SHADES: Final = ("light", "dark", "bright", "pale", "deep")
# gains of red, green and blue: as the camera shows them, and with its white balance wrong in both directions
_BALANCES: Final = ((1.0, 1.0, 1.0), (1.12, 1.0, 0.89), (0.89, 1.0, 1.12))
_MIN_OWN_SHARE: Final = 0.3
_MIN_POSSIBLE_SHARE: Final = 0.12


class _Range(NamedTuple):
    """A range of hue in degrees from -20 to 340, of saturation and of lightness; the upper limits are excluded.

    own: the term that names it, empty where no one does. possible: all terms that could name it.
    """

    hue_deg: tuple[float, float]
    saturation: tuple[float, float]
    lightness: tuple[float, float]
    own: str
    possible: str


_ANY: Final = (-1e9, 1e9)
_WARM: Final = (40.0, 112.0)
# the first range that a pixel falls into counts
_RANGES: Final = (
    _Range(_ANY, _ANY, (0.0, 0.14), "black", "black"),
    _Range(_ANY, (0.0, 0.09), (0.0, 0.30), "black", "black"),
    _Range(_ANY, _ANY, (0.0, 0.22), "", "black brown green blue red purple"),
    _Range(_ANY, (0.0, 0.07), (0.0, 0.42), "", "black grey"),
    _Range(_ANY, (0.0, 0.055), (0.42, 0.68), "grey", "grey white"),
    _Range(_ANY, (0.0, 0.055), (0.68, 0.80), "", "grey white"),
    _Range(_ANY, (0.0, 0.055), (0.80, 2.0), "white", "white grey"),
    # nearly neutral: the light's colour, or a faint colour of the object
    _Range(_WARM, (0.0, 0.09), (0.0, 0.45), "", "brown grey black"),
    _Range(_WARM, (0.0, 0.09), (0.45, 2.0), "", "white grey brown yellow"),
    _Range((112.0, 205.0), (0.0, 0.08), _ANY, "", "green blue grey"),
    _Range((205.0, 300.0), (0.0, 0.08), _ANY, "", "blue grey white"),
    _Range(_ANY, (0.0, 0.08), _ANY, "", "pink purple grey white brown"),
    _Range(_WARM, (0.09, 0.14), (0.60, 2.0), "", "brown yellow white"),
    _Range(_WARM, (0.09, 0.14), _ANY, "brown", "brown"),
    _Range((-20.0, 38.0), (0.0, 0.22), (0.68, 2.0), "pink", "pink red orange"),
    _Range((8.0, 34.0), _ANY, (0.0, 0.45), "red", "red brown"),
    _Range((8.0, 34.0), _ANY, _ANY, "red", "red pink"),
    _Range((34.0, 48.0), _ANY, (0.0, 0.50), "", "red brown orange"),
    _Range((34.0, 48.0), _ANY, _ANY, "", "red orange pink"),
    _Range((48.0, 76.0), (0.16, 9.0), (0.58, 2.0), "orange", "orange yellow brown"),
    _Range((76.0, 112.0), (0.13, 9.0), (0.60, 2.0), "yellow", "yellow orange brown"),
    _Range((48.0, 70.0), (0.17, 9.0), _ANY, "brown", "brown orange red"),
    _Range((70.0, 112.0), (0.15, 9.0), _ANY, "", "brown yellow orange green"),
    _Range((48.0, 112.0), _ANY, _ANY, "brown", "brown"),
    _Range((112.0, 125.0), _ANY, _ANY, "green", "green yellow brown"),
    _Range((125.0, 178.0), _ANY, _ANY, "green", "green"),
    _Range((178.0, 205.0), _ANY, _ANY, "", "green blue"),
    _Range((205.0, 285.0), _ANY, _ANY, "blue", "blue"),
    _Range((285.0, 303.0), _ANY, _ANY, "", "blue purple"),
    _Range((303.0, 332.0), _ANY, _ANY, "purple", "purple pink"),
    _Range(_ANY, _ANY, _ANY, "pink", "pink purple red"),
)

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


class ColourMatch(Enum):
    """Whether an object has the colour of a word."""

    YES = "yes"
    DOUBTFUL = "doubtful"
    NO = "no"


def colour_counts(rgb: UInt8[ndarray, "n 3"]) -> Float64[ndarray, "balances ranges"]:
    """Return the share of the pixels in each range of colours, for each white balance; zeros without pixels."""
    return np.stack([_range_shares(rgb.astype(np.float64) * gains) for gains in _BALANCES])


def no_colours() -> Float64[ndarray, "balances ranges"]:
    """Return the counts of an object without pixels."""
    return np.zeros((len(_BALANCES), len(_RANGES)))


def is_evaluated(colour: str) -> bool:
    """Return True if the words of a task's colour are known, such as "red", "light blue" or "black and white"."""
    return all(_base_word(each) in _TERMS_OF_WORD for each in colour.split(" and "))


def match_colour(colour: str, counts: Float64[ndarray, "balances ranges"]) -> ColourMatch:
    """Return whether an object with these sums of `colour_counts` has the colour.

    YES: ranges that the word names have 0.3 of the pixels, as the camera shows them. NO: ranges that it could name have
    less than 0.12 with every white balance. "black and white" needs both. DOUBTFUL otherwise, for unknown words, and
    without pixels.
    """
    total = float(counts[0].sum())
    if total == 0.0 or not is_evaluated(colour):
        return ColourMatch.DOUBTFUL
    matches = [_match_word(_base_word(each), counts / total) for each in colour.split(" and ")]
    if ColourMatch.NO in matches:
        return ColourMatch.NO
    return ColourMatch.YES if all(each is ColourMatch.YES for each in matches) else ColourMatch.DOUBTFUL


def _match_word(word: str, shares: Float64[ndarray, "balances ranges"]) -> ColourMatch:
    terms = set(_TERMS_OF_WORD[word])
    if float(shares[0, _is_named(terms, possibly=False)].sum()) >= _MIN_OWN_SHARE:
        return ColourMatch.YES
    possible = float(shares[:, _is_named(terms, possibly=True)].sum(axis=1).max())
    return ColourMatch.NO if possible < _MIN_POSSIBLE_SHARE else ColourMatch.DOUBTFUL


def _range_shares(rgb: Float64[ndarray, "n 3"]) -> Float64[ndarray, " ranges"]:
    lightness, hue_deg, saturation = _oklab(rgb)
    values = (hue_deg, saturation, lightness)
    is_free = np.ones(len(rgb), np.bool_)
    shares = np.zeros(len(_RANGES))
    for index, each in enumerate(_RANGES):
        is_inside = is_free.copy()
        for value, (low, high) in zip(values, each[:3], strict=True):
            is_inside &= (value >= low) & (value < high)
        shares[index] = np.count_nonzero(is_inside)
        is_free &= ~is_inside
    return shares / max(len(rgb), 1)


def _is_named(terms: set[str], possibly: bool) -> Bool[ndarray, " ranges"]:
    return np.array([not terms.isdisjoint((each.possible if possibly else each.own).split()) for each in _RANGES])


def _base_word(colour: str) -> str:
    """Return the word without its shade: "light blue" → "blue"."""
    return " ".join(word for word in colour.split() if word not in _SHADES)


def _oklab(
    rgb: Float64[ndarray, "n 3"],
) -> tuple[Float64[ndarray, " n"], Float64[ndarray, " n"], Float64[ndarray, " n"]]:
    """Return lightness, hue in degrees from -20 to 340, and saturation: the ratio of chroma to lightness."""
    linear = linear_light(np.minimum(rgb / 255.0, 1.0))
    lightness, a, b = (np.cbrt(linear @ _CONES_OF_RGB.T) @ _OKLAB_OF_CONES.T).T
    hue_deg = (np.degrees(np.arctan2(b, a)) + 20.0) % 360.0 - 20.0
    return lightness, hue_deg, np.hypot(a, b) / np.maximum(lightness, 1e-6)
