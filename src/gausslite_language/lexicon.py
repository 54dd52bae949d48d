"""Word lists of the rule parser: nouns, attributes, adverbs, negations, nouns that name no object; plurals."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from gausslite.domain.task import Superlative
from gausslite_language.nouns import is_thing
from gausslite_language.verbs import TABLES, words
from gausslite_language.verbs import word_set as word_set

COLOURS: Final = words("colours")
_SHADES: Final = word_set("light dark bright pale deep")
# a colour and a noun that together name another thing
_COLOUR_COMPOUNDS: Final = frozenset(tuple(pair.split("_")) for pair in words("colour_compounds"))
SUPERLATIVES: Final = {
    word: Superlative(name) for name, words_of_it in TABLES["superlatives"].items() for word in words_of_it.split()
}
COMPARATIVES: Final = frozenset(
    word
    for word, superlative in SUPERLATIVES.items()
    if word.endswith("er") and superlative not in (Superlative.NEAREST, Superlative.FARTHEST)
) | word_set("heavier lighter older newer thicker thinner")
DISTANCE_SUPERLATIVES: Final = frozenset({Superlative.NEAREST, Superlative.FARTHEST})
_ORDINALS: Final = word_set("first second third fourth fifth sixth seventh eighth ninth tenth eleventh twelfth last")
_JOINED: Final = "-and-"


@dataclass(frozen=True, slots=True)
class DescribedNoun:
    """A noun phrase without its attributes; unseen: its ordinals, and superlatives that geometry does not show."""

    noun: str
    colour: str | None = None
    superlative: Superlative | None = None
    unseen: tuple[str, ...] = ()


def is_ordinal(word: str) -> bool:
    """Return True for "second" and "2nd"."""
    return word in _ORDINALS or (word[:1].isdigit() and word.endswith(("st", "nd", "rd", "th")))


def is_attribute(word: str) -> bool:
    """Return True for words that never stand in a name."""
    return word in SUPERLATIVES or is_unseen(word) or is_ordinal(word) or _is_colour(word)


def is_unseen(word: str) -> bool:
    """Return True for the superlative or comparative of a property that geometry does not show: "oldest", "heavier"."""
    ending = next((ending for ending in ("est", "er") if word.endswith(ending)), None)
    if ending is None or word in ADJECTIVES or (ending == "er" and is_thing(word)):
        return word in ("best", "worst", "most", "least")
    stem = word.removesuffix(ending)
    return any(
        adjective in ADJECTIVES
        for adjective in (stem, stem + "e", stem[:-1] + "y") + (stem[:-1],) * (stem[-2:-1] == stem[-1:])
    )


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
        elif is_unseen(word) or (is_ordinal(word) and (word, following) != ("first", "aid")):
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
    return all(part in COLOURS for part in word.split(_JOINED))


ROOMS: Final = words("rooms")
COMMON_ANCHORS: Final = words("common_anchors")
CONTAINERS: Final = words("containers")
# nouns that are also verbs or adjectives, or that the vocabulary lacks
_OBJECTS: Final = words("objects")
NOUNS: Final = (
    _OBJECTS
    | ROOMS
    | COMMON_ANCHORS
    | CONTAINERS
    | frozenset({"object", "thing", "item", "stuff", "obstacle", "obstruction", "clutter", "hazard", "target"})
)


DETERMINERS: Final = words("determiners")
# indefinite pronouns, with the noun that a graph uses for them
INDEFINITE_PRONOUNS: Final = TABLES["indefinite_pronouns"]
# an ordinal that is part of a compound noun
COMPOUND_OPENERS: Final = frozenset({("first", "aid"), ("second", "hand")})
# irrelevant to the graph; most other adverbs end in -ly
ADVERBS: Final = words("adverbs")
# names and forms of address for the robot
ADDRESSEES: Final = words("addressees")

# nouns that refer to the task itself: "the goal is to", "any idea where"
TASK_NOUNS: Final = word_set("task mission goal job aim duty idea clue question problem help chance")
# nouns for places and properties: the object follows "of", or there is none
PLACES: Final = words("places")
# after a preposition and without an article they express manner or purpose: by hand, for lunch, in order
MANNER_NOUNS: Final = words("manner_nouns")
TIME_NOUNS: Final = words("time_nouns")
ROUTES: Final = word_set("path way route road course trajectory passage line shortcut track trail")
MEASURES: Final = words("measures")
# measures and places that a robot can also be asked to handle: "bring me the list"
PHYSICAL_MEASURES: Final = word_set("picture photo photograph map list model record sample copy")
# places that are also physical objects, unless "in" or "to" precedes them
PHYSICAL_PLACES: Final = word_set("home corner site front back")
PICTURES: Final = word_set("picture photo photograph image painting drawing poster portrait sketch statue")
BUILDINGS: Final = word_set("building house apartment")
# spaces around the robot, which state a context and no anchor; other rooms of the lexicon are objects
_SPACES: Final = (ROOMS - word_set("closet elevator staircase street sidewalk lawn driveway laundry")) | words("spaces")
_SPACE_HEADS: Final = word_set("room area lot hall park site zone storey wing department section suite court space")


def is_space(words: tuple[str, ...]) -> bool:
    """Return True if a noun phrase is a room or a place: "kitchen", "parking lot", "living room"."""
    named = [word for word in words if not word[:1].isdigit()] or list(words)
    return named[-1] in _SPACES or (len(words) > 1 and named[-1] in _SPACE_HEADS)


# defects that an inspection searches for in an object
BODY_PARTS: Final = word_set("hand hands arm arms finger fingers gripper grippers")
DEFECTS: Final = words("defects")
PEOPLE: Final = words("people")
CLOTHING: Final = words("clothing")
PARTS: Final = words("parts")
PASSAGES: Final = word_set("door doorway entrance gate archway")
# tools to take something with
HELD_TOOLS: Final = words("held_tools")
GENERIC: Final = word_set("object thing item stuff obstacle obstruction clutter hazard debris target")

ADJECTIVES: Final = COLOURS.union(SUPERLATIVES) | words("adjectives")

# words that always exclude the following noun or verb
NEGATIONS: Final = frozenset(tuple(negation.split()) for negation in str(TABLES["excluding"]).split("|"))


_IRREGULAR: Final = dict(pair.split(":") for pair in words("irregular_nouns"))
# words that singular() returns unchanged: plural in form only, or singular with a final s
UNCHANGED: Final = words("unchanged")


def singular(word: str) -> str:
    """Return the singular of a lower-case English word, or the word itself if it has none."""
    if word in _IRREGULAR:
        return _IRREGULAR[word]
    if word in UNCHANGED or len(word) <= 3 or not word.endswith("s") or word.endswith(("ss", "us", "is", "'s")):
        return word
    if word.endswith("ies"):
        return word[:-3] + "y"
    if word.endswith(("sses", "xes", "ches", "shes", "zzes")):
        return word[:-2]
    return word[:-1]
