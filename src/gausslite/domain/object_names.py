"""Heads, synonyms and categories of nouns; size limits and generic tasks depend on the categories."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

GENERIC: Final = frozenset(
    {"object", "thing", "item", "stuff", "obstacle", "obstruction", "clutter", "hazard", "debris", "target"}
)
# parts of a building or of the ground: a task that names any "object" does not mean these
STRUCTURE: Final = frozenset(
    {"wall", "floor", "ceiling", "ground", "roof", "room", "kitchen", "bathroom", "bedroom", "office", "hallway",
     "corridor", "road", "street", "sidewalk", "lawn", "grass", "sky", "stairs", "door", "window", "carpet", "rug"}
)  # fmt: skip
FURNITURE: Final = frozenset(
    {"chair", "armchair", "stool", "couch", "sofa", "loveseat", "bench", "table", "desk", "counter", "countertop",
     "bed", "shelf", "bookshelf", "bookcase", "cabinet", "cupboard", "dresser", "wardrobe", "closet", "sideboard",
     "refrigerator", "fridge", "freezer", "oven", "stove", "dishwasher", "sink", "toilet", "bathtub", "door", "window",
     "wall", "floor", "rug", "carpet", "car", "truck", "bus", "van", "boat", "train", "airplane", "tree", "person",
     "plant", "houseplant", "piano", "workbench", "nightstand", "ottoman",
     "television", "tv", "whiteboard", "curtain", "fence", "gate"}
)  # fmt: skip
# furniture and appliances of about a metre
MEDIUM: Final = frozenset(
    {"chair", "armchair", "stool", "nightstand", "ottoman", "toilet", "sink", "oven", "stove", "dishwasher", "tv",
     "television", "monitor", "suitcase", "lamp"}
)  # fmt: skip
# objects that may fill most of an image
SURFACE: Final = frozenset(
    {"table", "desk", "counter", "countertop", "bed", "workbench", "wall", "floor", "ceiling", "door", "rug", "carpet",
     "lawn", "grass", "road", "whiteboard"}
)  # fmt: skip
# parts of a large one look like a small one: a sofa's end like an armchair
SEAT: Final = frozenset({"chair", "armchair", "stool", "couch", "sofa", "loveseat", "bench", "ottoman"})
# seats that stand up: a flat surface is none of them
BACKED_SEAT: Final = frozenset({"chair", "armchair", "couch", "sofa", "loveseat"})
PLANT: Final = frozenset({"plant", "houseplant", "tree", "bush", "shrub", "fern", "flower", "bouquet", "ivy", "palm"})
# open vessels and boxes: what they hold belongs to them
CONTAINER: Final = frozenset(
    {"bowl", "basket", "box", "crate", "bin", "tray", "dish", "bucket", "tub", "basin", "pot", "pan", "carton"}
)
# synonyms; the first of each row is the canonical name
_SYNONYM_ROWS: Final = (
    ("cup", "mug", "teacup", "coffee mug", "coffee cup", "tumbler", "paper cup"),
    ("couch", "sofa", "settee", "loveseat", "futon"),
    ("tv", "television", "monitor", "screen", "display", "computer monitor", "tv screen"),
    ("dining table", "table", "desk", "coffee table", "counter", "countertop", "workbench", "kitchen table",
     "dinner table"),
    ("refrigerator", "fridge", "freezer"),
    ("cell phone", "phone", "smartphone", "mobile phone", "telephone", "cellphone", "mobile"),
    ("potted plant", "plant", "houseplant", "flowerpot", "planter", "pot plant"),
    ("chair", "armchair", "seat", "office chair", "lawn chair", "stool", "lounge chair", "folding chair"),
    ("person", "human", "man", "woman", "child", "pedestrian", "worker", "visitor", "boy", "girl", "kid", "baby"),
    ("bicycle", "bike"),
    ("motorcycle", "motorbike"),
    ("backpack", "rucksack"),
    ("handbag", "purse", "bag"),
    ("suitcase", "luggage", "briefcase"),
    ("remote", "remote control"),
    ("oven", "stove", "cooker"),
    ("microwave", "microwave oven"),
    ("mouse", "computer mouse"),
    ("keyboard", "computer keyboard"),
    ("laptop", "notebook computer", "laptop computer"),
    ("book", "notebook", "magazine"),
    ("airplane", "plane", "aeroplane", "aircraft"),
    ("donut", "doughnut"),
    ("hair drier", "hair dryer", "hairdryer", "blow dryer"),
    ("sports ball", "ball", "football", "basketball", "soccer ball"),
    ("wine glass", "glass", "goblet"),
    ("fire hydrant", "hydrant"),
    ("stop sign", "sign"),
    ("teddy bear", "teddy", "stuffed animal"),
)  # fmt: skip
SYNONYMS: Final = {name: row[0] for row in _SYNONYM_ROWS for name in row}


def head_of(phrase: str) -> str:
    """Return the head noun: "lawn chair" → "chair", "mug_2" → "mug"."""
    words = phrase.casefold().replace("_", " ").replace("-", " ").split()
    while len(words) > 1 and words[-1].isdigit():
        words.pop()
    return words[-1] if words else ""


def normalised_noun(phrase: str) -> str:
    """Return the phrase without a trailing number and with plain spaces: "dining_table_1" → "dining table"."""
    words = phrase.casefold().replace("_", " ").replace("-", " ").split()
    while len(words) > 1 and words[-1].isdigit():
        words.pop()
    return " ".join(words)


def is_generic(phrase: str) -> bool:
    """Return True if the phrase means any object."""
    return head_of(phrase) in GENERIC


def is_structure(phrase: str) -> bool:
    """Return True for parts of a building or of the ground: walls, floors, doors, rooms, roads."""
    return head_of(phrase) in STRUCTURE


def is_surface(phrase: str) -> bool:
    """Return True for tables, beds, walls and the like."""
    return head_of(phrase) in SURFACE


def is_medium(phrase: str) -> bool:
    """Return True for chairs, televisions and other objects of about a metre."""
    return head_of(phrase) in MEDIUM


def is_furniture(phrase: str) -> bool:
    """Return True for furniture and other objects that may fill much of an image."""
    return head_of(phrase) in FURNITURE


def is_seat(phrase: str) -> bool:
    """Return True for chairs, sofas, benches and the like."""
    return head_of(phrase) in SEAT


def has_back(phrase: str) -> bool:
    """Return True for chairs, sofas and other seats with a back."""
    return head_of(phrase) in BACKED_SEAT


def is_plant(phrase: str) -> bool:
    """Return True for plants and flowers: other things show between their leaves."""
    return head_of(phrase) in PLANT


def is_container(phrase: str) -> bool:
    """Return True for bowls, baskets, boxes and the like."""
    return head_of(phrase) in CONTAINER


def same_kind(phrase: str, name: str) -> bool:
    """Return True if a task's phrase means objects of this name: equal heads, or synonyms."""
    if is_generic(phrase):
        return not is_structure(name)
    normalised_phrase, other = normalised_noun(phrase), normalised_noun(name)
    if normalised_phrase == other or head_of(normalised_phrase) == head_of(other):
        return True
    canonical = SYNONYMS.get(normalised_phrase, SYNONYMS.get(head_of(normalised_phrase)))
    return canonical is not None and canonical == SYNONYMS.get(other, SYNONYMS.get(head_of(other)))


def meant_by(phrase: str, names: Iterable[str]) -> tuple[str, ...]:
    """Return the names of objects that a task's phrase means: those with its head, or its synonyms if there are none.

    "table" means a coffee table and not the counter, but a counter where there is no table; "chair" includes armchairs.
    """
    same = tuple(name for name in names if same_kind(phrase, name))
    head = head_of(normalised_noun(phrase))
    return tuple(name for name in same if head_of(normalised_noun(name)).endswith(head)) or same
