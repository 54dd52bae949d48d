"""Parse tasks by rules: no model, no network, a fraction of a millisecond, the same answer everywhere."""

from __future__ import annotations

from gausslite.domain.task import TaskGraph
from gausslite.errors import TaskError
from gausslite.task.chunk import Chunk, ChunkKind
from gausslite.task.chunker import read
from gausslite.task.graph_builder import build_draft
from gausslite.task.graph_grounding import grounded_graph
from gausslite.task.parser import normalise_text
from gausslite.task.validate import EXAMPLE, require_task_text


class RuleParser:
    """A TaskParser for English sentences about objects and where they are (Sec. III-B.1)."""

    def parse(self, text: str) -> TaskGraph:
        """The graph of one task. Raises TaskError."""
        require_task_text(text)
        chunks = read(normalise_text(text))
        _require_sense(text, chunks)
        draft = build_draft(chunks)
        if not draft.targets:
            raise TaskError(_nothing_named(text, tuple(draft.excluded)))
        return grounded_graph(text, draft.targets, draft.anchors, draft.relations, draft.warnings, draft)


def _require_sense(text: str, chunks: list[Chunk]) -> None:
    """Unknown words alone are noise; next to a verb, an article or a preposition they may be rare objects."""
    nouns = [chunk.noun for chunk in chunks if chunk.noun is not None]
    structured = any(chunk.kind in (ChunkKind.VERB, ChunkKind.PREPOSITION) for chunk in chunks)
    if not structured and not any(noun.is_known or noun.has_determiner for noun in nouns):
        raise TaskError(_nothing_named(text, ()))


def _nothing_named(text: str, excluded: tuple[str, ...]) -> str:
    shown = text.strip() if len(text.strip()) <= 60 else text.strip()[:57] + "..."
    came = repr(" ".join(shown.split()))
    if excluded:
        came = f"only objects to leave alone ({', '.join(excluded)}) in {came}"
    return f"task text: expected an English sentence that names an object, such as {EXAMPLE}, got {came}"
