"""The forms of verbs."""

from __future__ import annotations

from gausslite.task import lexicon


def verb_base(word: str) -> str | None:
    """The base form of a known verb in any of its forms, or None."""
    if word in lexicon.VERBS:
        return word
    if word in lexicon.IRREGULAR_VERBS:
        return lexicon.IRREGULAR_VERBS[word]
    for ending, replacements in (
        ("ies", ("y",)),
        ("ing", ("", "e")),
        ("es", ("", "e")),
        ("s", ("",)),
        ("ed", ("", "e")),
    ):
        if word.endswith(ending) and len(word) > len(ending) + 1:
            stem = word[: -len(ending)]
            for replacement in replacements:
                if stem + replacement in lexicon.VERBS:
                    return stem + replacement
    return None


def is_participle(word: str) -> bool:
    """True for "stacked", "left" or "lying": what may stand behind a noun and before a place."""
    regular = word.endswith("ed") or (word.endswith("ing") and verb_base(word) is not None)
    return regular or word in lexicon.IRREGULAR_PARTICIPLES
