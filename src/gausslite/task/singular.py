"""Convert English plurals to singulars, for the heads of noun phrases."""

from __future__ import annotations

from typing import Final

from gausslite.task.word_set import word_set

_IRREGULAR: Final = {
    "people": "person", "men": "man", "women": "woman", "children": "child", "feet": "foot", "teeth": "tooth",
    "mice": "mouse", "geese": "goose", "shelves": "shelf", "bookshelves": "bookshelf", "knives": "knife",
    "leaves": "leaf", "loaves": "loaf", "scarves": "scarf", "halves": "half", "wolves": "wolf", "lives": "life",
    "buses": "bus", "lenses": "lens", "viruses": "virus", "cacti": "cactus", "dice": "dice", "dies": "die",
    "tvs": "tv", "cds": "cd", "dvds": "dvd", "pcs": "pc",
    "ties": "tie", "pies": "pie", "cookies": "cookie", "brownies": "brownie", "movies": "movie", "hoodies": "hoodie",
    "selfies": "selfie", "potatoes": "potato", "tomatoes": "tomato", "mangoes": "mango", "heroes": "hero",
    "caches": "cache", "aches": "ache", "axes": "axe", "persons": "person", "gases": "gas", "calves": "calf",
    "humans": "human", "rubbish": "rubbish", "quizzes": "quiz", "policemen": "policeman", "workmen": "workman",
}  # fmt: skip
# words that singular() returns unchanged: plural in form only, or singular with a final s
UNCHANGED: Final = word_set(
    "scissors glasses sunglasses eyeglasses headphones earphones pants jeans trousers shorts pliers tongs tweezers "
    "binoculars goggles clothes stairs valuables electronics groceries gas bus lens news series species thermos "
    "asbestos christmas canvas atlas chaos always mass pass chess press cutlery pajamas pyjamas overalls tights "
    "leggings clippers shears remains goods supplies premises outdoors upstairs downstairs"
)


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
