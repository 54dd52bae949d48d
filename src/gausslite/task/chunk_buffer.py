"""The chunks of a sentence under construction, and the words around the current one."""

from __future__ import annotations

from collections.abc import Sequence

from gausslite.task.chunk import Chunk, ChunkKind
from gausslite.task.distances import Bounds
from gausslite.task.noun_phrase import noun_phrase
from gausslite.task.part_of_speech import Tag


class ChunkBuffer:
    """Collects chunks; `words` are those of the current noun phrase. index: position of the current word."""

    def __init__(self, tagged: Sequence[tuple[str, Tag]]) -> None:
        self.tagged = tagged
        self.index = 0
        self.chunks: list[Chunk] = []
        self.words: list[str] = []
        self.has_determiner = False
        self.determiner_at = 0
        self.negates_next = False

    def tag(self, offset: int) -> Tag | None:
        """Return the tag of a word by its offset from the current one; None outside the sentence."""
        position = self.index + offset
        return self.tagged[position][1] if 0 <= position < len(self.tagged) else None

    def word(self, offset: int) -> str:
        """Return a word by its offset from the current one; empty outside the sentence."""
        position = self.index + offset
        return self.tagged[position][0] if 0 <= position < len(self.tagged) else ""

    def last_kind(self) -> ChunkKind | None:
        """Return the kind of the latest complete chunk."""
        return self.chunks[-1].kind if self.chunks else None

    def last_verb(self) -> str:
        """Return the latest verb of the sentence so far; empty without one."""
        return next((chunk.word for chunk in reversed(self.chunks) if chunk.kind is ChunkKind.VERB), "")

    def emit(self, kind: ChunkKind, word: str, gerund: bool = False) -> None:
        """End the noun phrase and add a chunk."""
        self.close()
        self.chunks.append(Chunk(kind, word, gerund=gerund))

    def emit_preposition(
        self, relation: str, text: str = "", current_place: bool = False, bounds: Bounds | None = None
    ) -> None:
        """End the noun phrase and add a preposition, negated if a "not" precedes it."""
        self.close()
        negated, self.negates_next = self.negates_next, False
        self.chunks.append(
            Chunk(
                ChunkKind.PREPOSITION,
                relation,
                current_place=current_place,
                negated=negated,
                text=text or relation,
                bounds=bounds,
            )
        )

    def close(self) -> None:
        """End the current noun phrase."""
        if self.words:
            noun = noun_phrase(self.words, self.has_determiner)
            self.chunks.append(Chunk(ChunkKind.NOUN, self.words[-1], noun))
        self.words, self.has_determiner = [], False
