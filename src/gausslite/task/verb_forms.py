"""English verb forms to base forms, and the particles that belong to verbs, for the verbs that are known."""

from __future__ import annotations

from typing import Final

from gausslite.task.verbs import DELIVERY_VERBS, GO_VERBS, VERBS
from gausslite.task.word_set import word_set

# past forms and participles that do not end in -ed
_IRREGULAR: Final = {
    "fell": "fall", "fallen": "fall", "went": "go", "gone": "go", "got": "get", "gotten": "get", "came": "come",
    "stood": "stand", "sat": "sit", "lay": "lie", "laid": "lay", "lain": "lie", "ran": "run", "left": "leave",
    "kept": "keep", "hid": "hide", "hidden": "hide", "lost": "lose", "stuck": "stick", "hung": "hang",
    "found": "find", "put": "put", "set": "set", "seen": "see", "saw": "see", "made": "make", "built": "build",
    "held": "hold", "threw": "throw", "thrown": "throw", "broke": "break", "broken": "break", "sunk": "sink",
    "bent": "bend", "spilt": "spill", "took": "take", "taken": "take", "gave": "give", "given": "give",
    "brought": "bring", "bought": "buy", "sent": "send", "forgot": "forget", "forgotten": "forget", "shut": "shut",
    "cut": "cut", "hit": "hit", "let": "let", "lit": "light", "wore": "wear", "worn": "wear", "torn": "tear",
    "tore": "tear", "woke": "wake", "wrote": "write", "written": "write", "drawn": "draw", "drew": "draw",
    "grew": "grow", "grown": "grow", "blown": "blow", "blew": "blow", "swept": "sweep", "wound": "wind",
    "fed": "feed", "felt": "feel", "led": "lead", "met": "meet", "read": "read", "said": "say", "told": "tell",
    "sold": "sell", "slid": "slide", "spread": "spread", "stolen": "steal", "stole": "steal", "frozen": "freeze",
    "driven": "drive", "drove": "drive", "flown": "fly", "flew": "fly", "eaten": "eat", "ate": "eat",
    "drunk": "drink", "drank": "drink", "chosen": "choose", "knew": "know", "known": "know", "thought": "think",
    "burnt": "burn", "dug": "dig", "bound": "bind", "dealt": "deal", "heard": "hear",
    "leant": "lean", "leapt": "leap", "meant": "mean", "shown": "show", "slept": "sleep", "stung": "sting",
    "swung": "swing", "done": "do", "lent": "lend", "hurt": "hurt",
    "sprung": "spring", "woven": "weave", "strewn": "strew",
}  # fmt: skip
_PARTICLES: Final = word_set("up down off out over away around about back through along past at into across onto for")
_SWITCHED_ON: Final = word_set("turn switch power put bring check focus concentrate spot home work plug report")
# "bring in the boxes" needs an object before any place
_TAKES_AN_OBJECT: Final = DELIVERY_VERBS - GO_VERBS - word_set("rest lean pack slide place hide")


def base_of_s(word: str) -> str | None:
    """From "holds" and "carries" to "hold" and "carry"; None for what is no such form of a known verb."""
    if word.endswith("ies"):
        return _known(word[:-3] + "y", word[:-1])
    if word.endswith("es"):
        return _known(word[:-2], word[:-1])
    return _known(word[:-1]) if word.endswith("s") else None


def base_of_ing(word: str) -> str | None:
    """From "sitting" and "placing" to "sit" and "place"."""
    if word.endswith("ying"):
        return _known(word[:-3], word[:-3] + "e", word[:-4] + "ie")
    return _stem(word[:-3]) if word.endswith("ing") else None


def base_of_ed(word: str) -> str | None:
    """From "stacked", "dropped", "carried" and "fallen" to their base forms."""
    if word in _IRREGULAR:
        return _IRREGULAR[word]
    if word.endswith("ied"):
        return _known(word[:-3] + "y", word[:-1])
    return _stem(word[:-2]) if word.endswith("ed") else None


def verb_base(word: str) -> str | None:
    """The base form of a known verb in any of its forms, or None."""
    if word in VERBS:
        return word
    return base_of_s(word) or base_of_ing(word) or base_of_ed(word)


def is_particle(verb: str, word: str) -> bool:
    """True for `on` in "turn on the lamp", and for `at` in "look at the lamp", which says no more than the verb."""
    if word in ("on", "in"):
        return verb in _TAKES_AN_OBJECT or (word == "on" and verb in _SWITCHED_ON)
    return word in _PARTICLES


def _stem(stem: str) -> str | None:
    """A stem as it stands, with its silent e back, or with one of its doubled consonants."""
    doubled = len(stem) > 2 and stem[-1] == stem[-2]
    return _known(stem, stem + "e", stem[:-1] if doubled else "")


def _known(*forms: str) -> str | None:
    return next((form for form in forms if form in VERBS), None)
