"""Score a task parser on sentences with known graphs: how often it is right, and how long it takes."""

from __future__ import annotations

import json
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gausslite.domain.task import Predicate, Relation, TaskGraph
from gausslite.errors import InvalidInputError, TaskError
from gausslite.task.parser import TaskParser

SENTENCES = Path(__file__).with_name("parser_sentences.json")


@dataclass(frozen=True, slots=True)
class Sentence:
    """A task and its graph; order does not matter."""

    text: str
    targets: frozenset[str]
    anchors: frozenset[str]
    relations: frozenset[Relation]

    @classmethod
    def from_row(cls, row: Mapping[str, Any]) -> Sentence:
        """From text, targets, anchors and relations as [predicate, target, anchor]."""
        relations = frozenset(Relation(Predicate(name), target, anchor) for name, target, anchor in row["relations"])
        return cls(row["text"], frozenset(row["targets"]), frozenset(row["anchors"]), relations)


@dataclass(frozen=True, slots=True)
class ParserScore:
    """Shares of the sentences, milliseconds a sentence, and the texts whose graph is not exact."""

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
    """The sentences of a JSON file. Raises InvalidInputError, OSError."""
    try:
        found = [Sentence.from_row(row) for row in json.loads(path.read_text(encoding="utf-8"))]
    except (ValueError, KeyError, TypeError) as error:
        expected = "a list of text, targets, anchors and relations [predicate, target, anchor]"
        raise InvalidInputError(f"{path}: expected {expected}, got another thing") from error
    if not found:
        raise InvalidInputError(f"{path}: expected at least one sentence, got none")
    return found


def score_parser(
    backend: str, parser: TaskParser, sentences: Sequence[Sentence], clock_s: Callable[[], float] = time.perf_counter
) -> ParserScore:
    """Parse every sentence once; one that is refused counts as wrong."""
    right: list[tuple[bool, bool, bool]] = []
    times_ms: list[float] = []
    fallbacks = 0
    for sentence in sentences:
        started_s = clock_s()
        graph = _graph_or_none(parser, sentence.text)
        times_ms.append(1e3 * (clock_s() - started_s))
        right.append(_right(sentence, graph))
        fallbacks += graph is not None and any(said.startswith("backend ") for said in graph.warnings)
    targets, anchors, exact = (statistics.fmean(column) for column in zip(*right, strict=True))
    wrong = tuple(each.text for each, (_, _, is_exact) in zip(sentences, right, strict=True) if not is_exact)
    return ParserScore(
        backend, len(right), exact, targets, anchors, statistics.median(times_ms), max(times_ms), fallbacks, wrong
    )


def _graph_or_none(parser: TaskParser, text: str) -> TaskGraph | None:
    try:
        return parser.parse(text)
    except TaskError:
        return None


def _right(sentence: Sentence, graph: TaskGraph | None) -> tuple[bool, bool, bool]:
    if graph is None:
        return False, False, False
    targets, anchors = sentence.targets == set(graph.targets), sentence.anchors == set(graph.anchors)
    return targets, anchors, targets and anchors and sentence.relations == set(graph.relations)
