"""Apply what a speaker corrects: "take the hammer, no wait, the mallet" becomes "take the mallet, not the hammer"."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import dropwhile, takewhile
from typing import Final

from gausslite_language.chunk import Chunk, ChunkKind, adjectives_only
from gausslite_language.tokens import CORRECTION_MARKER
from gausslite_language.verbs import PLACE_VERBS, TRAVEL_VERBS

_DENIAL: Final = (Chunk(ChunkKind.CONJUNCTION, ","), Chunk(ChunkKind.NEGATION, "not"))
_BREAK: Final = Chunk(ChunkKind.CLAUSE_BREAK, ";")
_MARKER: Final = Chunk(ChunkKind.CLAUSE_BREAK, CORRECTION_MARKER)
_PHRASE: Final = (ChunkKind.NOUN, ChunkKind.PREPOSITION, ChunkKind.ATTRIBUTE)


def apply_corrections(chunks: Sequence[Chunk]) -> list[Chunk]:
    """Return the chunks with each corrected phrase in its place, and the denial of what it replaces after it."""
    chunks = list(chunks)
    while _MARKER in chunks:
        at = chunks.index(_MARKER)
        before = list(dropwhile(_is_break, reversed(chunks[:at])))[::-1]
        chunks = _correct(before, list(dropwhile(_is_break, chunks[at + 1 :])))
    return chunks


def _is_break(chunk: Chunk) -> bool:
    return chunk.kind in (ChunkKind.CLAUSE_BREAK, ChunkKind.CONJUNCTION, ChunkKind.STATEMENT)


def _correct(before: list[Chunk], after: list[Chunk]) -> list[Chunk]:
    verb_at = max((at for at, chunk in enumerate(before) if chunk.kind is ChunkKind.VERB), default=-1)
    nouns = {at: chunk.noun for at, chunk in enumerate(before) if chunk.noun is not None and at > verb_at}
    if not nouns or not after:
        return [*before, _BREAK, *after]
    verb = before[verb_at].word if verb_at >= 0 else ""
    if after[0].kind is ChunkKind.VERB and after[0].word == verb:
        after = after[1:]
    new = list(takewhile(lambda chunk: chunk.kind in _PHRASE, after))
    rest = after[len(new) :]
    if not new:  # another verb
        return [*before, Chunk(ChunkKind.NOT_UNDERSTOOD, "a correction"), _BREAK, *after]
    places = [at for at in nouns if before[at - 1].kind is ChunkKind.PREPOSITION]
    noun = new[0].noun
    if noun is None:
        return _correct_place(before, places, new) + rest
    same = [at for at, known in nouns.items() if known.head == noun.head]
    alike = [at for at, known in nouns.items() if known.is_plural == noun.is_plural] or nouns
    goes_there = verb in PLACE_VERBS | TRAVEL_VERBS or (places and before[places[-1] - 1].word == "to")
    at = same[-1] if same else max(alike) if goes_there else min(alike)
    return _correct_noun(before, at, new, verb_at) + rest


def _correct_place(before: list[Chunk], places: list[int], new: list[Chunk]) -> list[Chunk]:
    """Return "on the shelf, not on the table" for a place that replaces the latest one."""
    if not places or len(new) < 2:
        return before + new
    at = places[-1] - 1
    preposition, place = before[at : at + 2]
    if place.noun == new[1].noun:
        return before[:at] + new + before[at + 2 :]
    denial = [*_DENIAL, place] if preposition.word == "to" else [_DENIAL[0], replace(preposition, negated=True), place]
    return before[:at] + new + before[at + 2 :] + denial


def _correct_noun(before: list[Chunk], at: int, new: list[Chunk], verb_at: int) -> list[Chunk]:
    """Return the chunks with the noun replaced, after its denial; of a noun that stays, its place changes."""
    old, noun = before[at], new[0].noun
    if old.noun is None or noun is None:
        return before + new
    is_one = noun.head in ("one", "ones")
    if is_one:
        kind = [word for word in old.noun.words[:-1] if not adjectives_only((word,))]
        noun = replace(noun, words=(*noun.words[:-1], *kind, old.noun.head))
    described, named = before[at + 1 :], [replace(new[0], word=noun.head, noun=noun), *new[1:]]
    if noun.text != old.noun.text:
        refines = is_one and noun.text.endswith(f" {old.noun.text}")  # "the hammer. No, the bigger one"
        denial = [] if refines else [*_DENIAL[1:], old, _BREAK]
        start = max(verb_at, 0)
        return before[:start] + denial + before[start:at] + named + ([] if len(new) > 1 else described)
    if len(new) == 1:  # "the other one"
        return [*before, Chunk(ChunkKind.NOT_UNDERSTOOD, f"the other {noun.text}")]
    denied = [replace(chunk, negated=not chunk.negated) for chunk in described]
    return before[:at] + named + ([_DENIAL[0], *denied] if denied else [])
