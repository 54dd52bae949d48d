"""Convert forms of known English verbs to base forms, and recognise the particles of verbs."""

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
    return base_of_s(word) or base_of_ing(word) or base_of_ed(word)


def is_particle(verb: str, word: str) -> bool:
    """Return True if the word belongs to the verb: "on" in "turn on the lamp", "at" in "look at the lamp"."""
    if word in ("on", "in"):
        return verb in _TAKES_AN_OBJECT or (word == "on" and verb in _SWITCHED_ON)
    return word in _PARTICLES


def _stem(stem: str) -> str | None:
    """Return the known verb of a stem: unchanged, with a silent e, or without a doubled consonant."""
    doubled = len(stem) > 2 and stem[-1] == stem[-2]
    return _known(stem, stem + "e", stem[:-1] if doubled else "")


def _known(*forms: str) -> str | None:
    return next((form for form in forms if form in VERBS), None)
