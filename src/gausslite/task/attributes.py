"""Colours and superlatives of noun phrases: "the smallest red screw" is a "screw" with two attributes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from gausslite.domain.task import Superlative
from gausslite.task.word_set import word_set

COLOURS: Final = word_set(
    "red green blue yellow orange black white grey gray brown pink purple beige silver golden gold turquoise violet "
    "maroon navy crimson scarlet ivory cream tan bronze teal lilac magenta cyan amber khaki indigo"
)
_SHADES: Final = word_set("light dark bright pale deep")
# a colour and a noun that together name another thing
_COLOUR_COMPOUNDS: Final = frozenset(
    tuple(pair.split("_"))
    for pair in [
        "orange_juice",
        "orange_tree",
        "orange_peel",
        "red_wine",
        "white_wine",
        "green_tea",
        "black_tea",
        "black_coffee",
        "black_pepper",
        "white_bread",
        "brown_bread",
        "brown_rice",
        "brown_sugar",
        "white_sugar",
        "red_cross",
        "blue_cheese",
        "cream_cheese",
        "green_bean",
        "red_onion",
        "green_onion",
        "red_cabbage",
        "black_box",
        "white_board",
        "black_board",
        "ice_cream",
        "yellow_page",
        "gold_fish",
        "silver_foil",
        "black_hole",
        "green_house",
        "red_light_district",
        "orange_slice",
        "red_meat",
        "white_chocolate",
    ]
)
_WORDS_OF_SUPERLATIVE: Final = {
    Superlative.LARGEST: "largest biggest hugest greatest larger bigger",
    Superlative.SMALLEST: "smallest tiniest littlest smaller tinier littler",
    Superlative.TALLEST: "tallest taller",
    Superlative.SHORTEST: "shortest shorter",
    Superlative.LONGEST: "longest longer",
    Superlative.WIDEST: "widest wider broadest broader",
    Superlative.NARROWEST: "narrowest narrower",
    Superlative.THICKEST: "thickest thicker fattest fatter",
    Superlative.THINNEST: "thinnest thinner slimmest slimmer",
    Superlative.HIGHEST: "highest topmost uppermost higher",
    Superlative.LOWEST: "lowest bottommost lowermost",
    Superlative.LEFTMOST: "leftmost left-most",
    Superlative.RIGHTMOST: "rightmost right-most",
    Superlative.NEAREST: "nearest closest nearer closer",
    Superlative.FARTHEST: "farthest furthest farther further remotest",
}
SUPERLATIVES: Final = {word: each for each, words in _WORDS_OF_SUPERLATIVE.items() for word in words.split()}
COMPARATIVES: Final = frozenset(
    word
    for word, each in SUPERLATIVES.items()
    if word.endswith("er") and each not in (Superlative.NEAREST, Superlative.FARTHEST)
) | word_set("heavier lighter older newer thicker thinner")
DISTANCE_SUPERLATIVES: Final = frozenset({Superlative.NEAREST, Superlative.FARTHEST})
# superlatives of properties that geometry does not show
UNSEEN_SUPERLATIVES: Final = word_set(
    "oldest newest heaviest lightest cheapest cleanest dirtiest hottest coldest warmest coolest best worst fastest "
    "slowest freshest strongest weakest hardest softest brightest darkest safest loudest quietest ripest sharpest "
    "youngest latest earliest nicest prettiest fullest emptiest driest wettest finest poorest richest heavier older "
    "newer cheaper dirtier hotter colder warmer younger fresher sturdiest busiest simplest easiest fanciest "
    "darker "
    "brighter softer harder stronger weaker fuller emptier dirtiest drier wetter safer"
)
ORDINALS: Final = word_set("first second third fourth fifth sixth seventh eighth ninth tenth last")
_JOINED: Final = "-and-"


@dataclass(frozen=True, slots=True)
class DescribedNoun:
    """A noun phrase without its attributes; unseen: its ordinals, and superlatives that geometry does not show."""

    noun: str
    colour: str | None = None
    superlative: Superlative | None = None
    unseen: tuple[str, ...] = ()


def is_attribute(word: str) -> bool:
    """Return True for words that never stand in a name."""
    return word in SUPERLATIVES or word in UNSEEN_SUPERLATIVES or word in ORDINALS or _is_colour(word)


def split_attributes(phrase: str) -> DescribedNoun:
    """Return the noun of a phrase, and its attributes; the head noun always stays."""
    *words, head = phrase.split()
    kept: list[str] = []
    colours: list[str] = []
    unseen: list[str] = []
    superlative: Superlative | None = None
    for at, word in enumerate(words):
        following = words[at + 1] if at + 1 < len(words) else head
        if word in SUPERLATIVES:
            superlative = SUPERLATIVES[word]
        elif word in UNSEEN_SUPERLATIVES or (word in ORDINALS and (word, following) != ("first", "aid")):
            unseen.append(word)
        elif (_is_colour(word) and (word, following) not in _COLOUR_COMPOUNDS) or (
            word in _SHADES and _is_colour(following) and at + 1 < len(words)
        ):
            colours.append(word)
        else:
            kept.append(word)
    colour = " ".join(colours).replace(_JOINED, " and ").replace("gray", "grey") or None
    return DescribedNoun(" ".join((*kept, head)), colour, superlative, tuple(unseen))


def _is_colour(word: str) -> bool:
    return all(each in COLOURS for each in word.split(_JOINED))
