"""Parse tasks by rules, without a model or a network, in less than a millisecond."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Final

from gausslite.domain.errors import TaskError
from gausslite.domain.task import EXAMPLE, TargetRole, TaskGraph, require_task_text
from gausslite_language.chunk import Chunk, ChunkKind
from gausslite_language.chunker import chunk_tagged
from gausslite_language.doubts import lost_nouns, unknown_names
from gausslite_language.graph_builder import build_draft
from gausslite_language.graph_draft import GraphDraft
from gausslite_language.grounding import ParsedPhrases, grounded_graph, normalise_text, task_id_of
from gausslite_language.spelling import is_in_dictionary, read_typed
from gausslite_language.tags import is_english, tag_words
from gausslite_language.tokens import comparisons, lexical_units, tokenize
from gausslite_language.verbs import ASPECT_VERBS, AVOIDING_VERBS

_AVOIDS: Final = AVOIDING_VERBS - ASPECT_VERBS
_CODE: Final = re.compile(r"[{}\[\]<=|\\$*]|(?<![-=])>|\w\(|&&|^import ")


class RuleParser:
    """A TaskParser for English sentences about objects and their places (Sec. III-B.1)."""

    def parse(self, text: str) -> TaskGraph:
        """Return the graph of one task. Raises TaskError."""
        return self.parse_counting(text)[0]

    def parse_counting(self, text: str) -> tuple[TaskGraph, tuple[str, ...]]:
        """Return the graph of one task, and the nouns of the sentence that the graph lacks. Raises TaskError."""
        require_task_text(text)
        read = read_typed(text, normalise_text(text))
        tagged = tag_words(lexical_units(read.text))
        chunks = chunk_tagged(tagged)
        _require_structure(text, read.text, chunks)
        draft = build_draft(chunks)
        if not draft.targets:
            raise TaskError(_no_object_message(text, tuple(draft.excluded)))
        draft.warnings += [f"{comparison!r} is not understood: it is dropped" for comparison in comparisons(read.text)]
        if _loses_negation(chunks, draft):
            draft.warnings.append("a negation is not understood: it is dropped")
        lost = lost_nouns(tagged, draft)
        draft.warnings += map(lost_warning, lost)
        draft.warnings += [f"{name!r} is no known noun: it may be misread" for name in unknown_names(draft)]
        parsed = ParsedPhrases(
            targets={target: draft.roles[target] for target in draft.targets},
            anchors=draft.anchors,
            relations=draft.relations,
            excluded=draft.excluded,
            context=draft.context,
            warnings=(*read.warnings, *draft.warnings),
            mentions=draft.mentions,
        )
        graph = grounded_graph(read.text, parsed, draft)
        return replace(graph, task_id=task_id_of(text), text=text.strip()), lost


def lost_warning(noun: str) -> str:
    """Return the warning about a noun that the graph lacks."""
    return f"{noun!r} is not part of the task"


def _loses_negation(chunks: list[Chunk], draft: GraphDraft) -> bool:
    """Return True if the sentence negates something and neither the graph nor a warning says so."""
    negates = any(chunk.kind is ChunkKind.NEGATION or chunk.negated or chunk.word in _AVOIDS for chunk in chunks)
    is_stated = draft.warnings or draft.excluded or TargetRole.OBSTACLE in draft.roles.values()
    return negates and not is_stated and not any(relation.negated for relation in draft.relations)


def _require_structure(text: str, read: str, chunks: list[Chunk]) -> None:
    """Raise TaskError for code, for mostly unknown words, as in another language, and for unknown words alone.

    A sentence of typing errors is English only if every unknown word is read as a known one.
    """
    nouns = [chunk.noun for chunk in chunks if chunk.noun is not None]
    words = [word for word in tokenize(normalise_text(text)) if word[0].isalpha()]
    typed = [word for word in words if not is_english(word)]
    unknown = [word for word in tokenize(read) if word[0].isalpha() and not is_english(word)]
    unknown += filter(is_in_dictionary, typed)
    prepositions = any(chunk.kind is ChunkKind.PREPOSITION for chunk in chunks)
    plain = not prepositions and not any(noun.has_determiner for noun in nouns)
    is_foreign = len(words) > 2 and bool(unknown) and (2 * len(typed) > len(words) or (plain and len(typed) > 1))
    if _CODE.search(text) or is_foreign:
        raise TaskError(_no_object_message(text, ()))
    has_structure = prepositions or any(chunk.kind is ChunkKind.VERB for chunk in chunks)
    if not has_structure and not any(noun.is_known or noun.has_determiner for noun in nouns):
        raise TaskError(_no_object_message(text, ()))


def _no_object_message(text: str, excluded: tuple[str, ...]) -> str:
    shown = text.strip() if len(text.strip()) <= 60 else text.strip()[:57] + "..."
    received = repr(" ".join(shown.split()))
    if excluded:
        received = f"only objects to leave alone ({', '.join(excluded)}) in {received}"
    return f"task text: expected an English sentence that names an object, such as {EXAMPLE}, got {received}"
