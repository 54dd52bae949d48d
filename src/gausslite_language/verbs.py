"""The vocabulary of verbs: known verbs by the roles that they give to their nouns, and the forms of a verb."""

from __future__ import annotations

import tomllib
from importlib import resources
from typing import Final


def word_set(text: str) -> frozenset[str]:
    """Return the set of the words of a text."""
    return frozenset(text.split())


TABLES: Final = tomllib.loads(resources.files("gausslite_language").joinpath("words.toml").read_text(encoding="utf-8"))


def words(name: str) -> frozenset[str]:
    """Return a word list of `words.toml`."""
    return word_set(TABLES[name])


GO_VERBS: Final = words("go_verbs")
CARRY_VERBS: Final = words("carry_verbs")
PLACE_VERBS: Final = words("place_verbs")
TOOL_VERBS: Final = words("tool_verbs")
SEARCH_VERBS: Final = words("search_verbs")
INSPECTION_VERBS: Final = word_set("check scan inspect survey examine test monitor probe assess audit")
LOOKING_VERBS: Final = SEARCH_VERBS | GO_VERBS | words("looking_verbs")
# with and without an object: "move to the chair", "move the chair to the door"
MOVING_VERBS: Final = word_set("move roll run advance return get land park dock drive fly race swing back reverse")
# a room that the robot leaves or crosses
LEAVING_VERBS: Final = word_set("exit leave cross pass traverse")
LEADING_VERBS: Final = word_set("follow escort guide lead accompany")
# the person is the recipient
SPEAKING_VERBS: Final = word_set("tell say speak talk")
STOPPING_VERBS: Final = word_set("stop wait stand stay sit halt pause hover")
TRAVEL_VERBS: Final = GO_VERBS | STOPPING_VERBS
# "hand the nurse the towel": the first noun is the recipient
GIVING_VERBS: Final = words("giving_verbs")
# verbs before a gerund that is the instruction: "keep wiping tables", unlike "take folding chairs"
ASPECT_VERBS: Final = words("aspect_verbs")
# "load the van with boxes": the boxes are the target
FILLING_VERBS: Final = word_set("load reload stock restock fill refill")
# "the mugs belong in the cupboard", "the boxes go on the shelf": the subject is the target
BELONGING_VERBS: Final = word_set("belong go come")
# "the shelf that holds the cans": the object is near the subject, unlike "the key that opens the cabinet"
HOLDING_VERBS: Final = words("holding_verbs")
# "tape the note on the door", "move the mug to the left of the plate": the place is the destination
ATTACHING_VERBS: Final = words("attaching_verbs")
PUSHING_VERBS: Final = word_set("move shift push slide drag pull roll nudge place put wheel cart tow")
# "bring the box with the label": what the object has, not a tool
FETCHING_VERBS: Final = words("fetching_verbs")
# "the mug that does not stand on the table"
RESTING_VERBS: Final = word_set("hang stand sit lie rest lean")
POSTURE_VERBS: Final = RESTING_VERBS | word_set("belong go locate live stick place mount park")
# negated, these mean contact or harm: the object is an obstacle
CONTACT_VERBS: Final = words("contact_verbs")
# the direct object is where the robot goes
REACHING_VERBS: Final = word_set("approach reach enter visit board")
# the robot keeps away from the direct object
AVOIDING_VERBS: Final = word_set("avoid dodge evade circumvent bypass mind beware")
DELIVERY_VERBS: Final = CARRY_VERBS | PLACE_VERBS
# "clean the kitchen": everything in it
COVERING_VERBS: Final = SEARCH_VERBS | INSPECTION_VERBS | TOOL_VERBS | words("covering_verbs")
# their object is a thing that exists: "fetch the map", unlike "make a map" and "take a picture"
HANDLING_VERBS: Final = words("handling_verbs")
VERBS: Final = FILLING_VERBS | INSPECTION_VERBS.union(*(words(name) for name in TABLES if name.endswith("_verbs")))

# past forms and participles that do not end in -ed
_IRREGULAR: Final = dict(pair.split(":") for pair in words("irregular_verb_forms"))
_PARTICLES: Final = word_set("up down off out over away around about back through along past at into across onto for")
_SWITCHED_ON: Final = word_set("turn switch power put bring check focus concentrate spot home work plug report")
# after these verbs "in" or "on" is a particle: "bring in the boxes"
_TAKES_AN_OBJECT: Final = DELIVERY_VERBS - GO_VERBS - word_set("rest lean pack slide place hide")


def base_of_s(word: str) -> str | None:
    """Return "hold" for "holds" and "carry" for "carries"; None if no known verb has this form."""
    if word.endswith("ies"):
        return _known(word[:-3] + "y", word[:-1])
    if word.endswith("es"):
        return _known(word[:-2], word[:-1])
    return _known(word[:-1]) if word.endswith("s") else None


def base_of_ing(word: str) -> str | None:
    """Return "sit" for "sitting" and "place" for "placing"; None if no known verb has this form."""
    if word.endswith("ying"):
        return _known(word[:-3], word[:-3] + "e", word[:-4] + "ie")
    return _stem(word[:-3]) if word.endswith("ing") else None


def base_of_ed(word: str) -> str | None:
    """Return the base form of "stacked", "dropped", "carried" or "fallen"; None if no known verb has this form."""
    if word in _IRREGULAR:
        return _IRREGULAR[word]
    if word.endswith("ied"):
        return _known(word[:-3] + "y", word[:-1])
    return _stem(word[:-2]) if word.endswith("ed") else None


def verb_base(word: str) -> str | None:
    """Return the base form of a known verb from any of its forms, or None."""
    if word in VERBS:
        return word
    return base_of_s(word) or base_of_ing(word) or base_of_ed(word) or _known(word.removeprefix("re"))


def is_particle(verb: str, word: str) -> bool:
    """Return True if the word belongs to the verb: "on" in "turn on the lamp", "at" in "look at the lamp"."""
    if word in ("on", "in"):
        return verb in _TAKES_AN_OBJECT or (word == "on" and verb in _SWITCHED_ON)
    return word in _PARTICLES and not (word in ("into", "onto") and verb in GO_VERBS)


def _stem(stem: str) -> str | None:
    """Return the known verb of a stem: unchanged, with a silent e, or without a doubled consonant."""
    doubled = len(stem) > 2 and stem[-1] == stem[-2]
    return _known(stem, stem + "e", stem[:-1] if doubled else "")


def _known(*forms: str) -> str | None:
    return next((form for form in forms if form in VERBS), None)
