"""Scores of a task parser on sentences with known task graphs: accuracy and time."""

from __future__ import annotations

import json
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gausslite.domain.errors import InvalidInputError, TaskError
from gausslite.domain.task import Predicate, Relation, TaskGraph
from gausslite.task.parser import TaskParser

SENTENCES = Path(__file__).with_name("parser_sentences.json")


@dataclass(frozen=True, slots=True)
class Sentence:
    """A task sentence and its expected graph; order is ignored."""

    text: str
    targets: frozenset[str]
    anchors: frozenset[str]
    relations: frozenset[Relation]

    @classmethod
    def from_row(cls, row: Mapping[str, Any]) -> Sentence:
        """Return the sentence of a JSON row: text, targets, anchors, relations as [predicate, target, anchor]."""
        relations = frozenset(Relation(Predicate(name), target, anchor) for name, target, anchor in row["relations"])
        return cls(row["text"], frozenset(row["targets"]), frozenset(row["anchors"]), relations)


@dataclass(frozen=True, slots=True)
class ParserScore:
    """Shares of correct sentences, milliseconds per sentence, and the texts whose graph is not exact."""

    backend: str
    sentences: int
    exact: float
    target_set: float
    anchor_set: float
    median_ms: float
    slowest_ms: float
    by_fallback: int
    wrong: tuple[str, ...]


def load_sentences(path: Path = SENTENCES) -> list[Sentence]:
    """Return the sentences of a JSON file. Raises InvalidInputError, OSError."""
    try:
        sentences = [Sentence.from_row(row) for row in json.loads(path.read_text(encoding="utf-8"))]
    except (ValueError, KeyError, TypeError) as error:
        expected = "a list of text, targets, anchors and relations [predicate, target, anchor]"
        raise InvalidInputError(f"{path}: expected {expected}, got other content") from error
    if not sentences:
        raise InvalidInputError(f"{path}: expected at least one sentence, got none")
    return sentences


def score_parser(
    backend: str, parser: TaskParser, sentences: Sequence[Sentence], clock_s: Callable[[], float] = time.perf_counter
) -> ParserScore:
    """Return the scores of parsing every sentence once; a sentence that raises TaskError counts as wrong."""
    matches: list[tuple[bool, bool, bool]] = []
    times_ms: list[float] = []
    fallbacks = 0
    for sentence in sentences:
        started_s = clock_s()
        graph = _graph_or_none(parser, sentence.text)
        times_ms.append(1e3 * (clock_s() - started_s))
        matches.append(_compare(sentence, graph))
        fallbacks += graph is not None and any(warning.startswith("backend ") for warning in graph.warnings)
    targets, anchors, exact = (statistics.fmean(column) for column in zip(*matches, strict=True))
    wrong = tuple(each.text for each, (_, _, is_exact) in zip(sentences, matches, strict=True) if not is_exact)
    return ParserScore(
        backend, len(matches), exact, targets, anchors, statistics.median(times_ms), max(times_ms), fallbacks, wrong
    )


def _graph_or_none(parser: TaskParser, text: str) -> TaskGraph | None:
    try:
        return parser.parse(text)
    except TaskError:
        return None


def _compare(sentence: Sentence, graph: TaskGraph | None) -> tuple[bool, bool, bool]:
    """Return whether the targets, the anchors and the whole graph are correct."""
    if graph is None:
        return False, False, False
    targets, anchors = sentence.targets == set(graph.targets), sentence.anchors == set(graph.anchors)
    return targets, anchors, targets and anchors and sentence.relations == set(graph.relations)
