"""Parse tasks by rules: deterministic, without a model or a network, in less than a millisecond."""

from __future__ import annotations

from gausslite.domain.errors import TaskError
from gausslite.domain.task import TaskGraph
from gausslite.domain.task_limits import EXAMPLE, require_task_text
from gausslite.task.chunk import Chunk, ChunkKind
from gausslite.task.chunker import chunk_sentence
from gausslite.task.graph_builder import build_draft
from gausslite.task.graph_grounding import ParsedPhrases, grounded_graph
from gausslite.task.idioms import comparisons
from gausslite.task.parser import normalise_text


class RuleParser:
    """A TaskParser for English sentences about objects and their places (Sec. III-B.1)."""

    def parse(self, text: str) -> TaskGraph:
        """Return the graph of one task. Raises TaskError."""
        require_task_text(text)
        chunks = chunk_sentence(normalise_text(text))
        _require_structure(text, chunks)
        draft = build_draft(chunks)
        if not draft.targets:
            raise TaskError(_no_object_message(text, tuple(draft.excluded)))
        draft.warnings += [f"{each!r} is not understood: it is dropped" for each in comparisons(normalise_text(text))]
        parsed = ParsedPhrases(
            targets={target: draft.roles[target] for target in draft.targets},
            anchors=draft.anchors,
            relations=draft.relations,
            excluded=draft.excluded,
            context=draft.context,
            warnings=draft.warnings,
            mentions=draft.mentions,
        )
        return grounded_graph(text, parsed, draft)


def _require_structure(text: str, chunks: list[Chunk]) -> None:
    """Raise TaskError for unknown words alone; with a verb, an article or a preposition they may be rare objects."""
    nouns = [chunk.noun for chunk in chunks if chunk.noun is not None]
    has_structure = any(chunk.kind in (ChunkKind.VERB, ChunkKind.PREPOSITION) for chunk in chunks)
    if not has_structure and not any(noun.is_known or noun.has_determiner for noun in nouns):
        raise TaskError(_no_object_message(text, ()))


def _no_object_message(text: str, excluded: tuple[str, ...]) -> str:
    shown = text.strip() if len(text.strip()) <= 60 else text.strip()[:57] + "..."
    received = repr(" ".join(shown.split()))
    if excluded:
        received = f"only objects to leave alone ({', '.join(excluded)}) in {received}"
    return f"task text: expected an English sentence that names an object, such as {EXAMPLE}, got {received}"
