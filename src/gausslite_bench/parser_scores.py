"""Scores of a task parser on sentences with known task graphs: accuracy and time."""

from __future__ import annotations

import json
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from gausslite.codec.json import graph_from_json
from gausslite.domain.errors import InvalidInputError, TaskError
from gausslite.domain.task import TargetRole, TaskGraph, TaskParser

SENTENCES = Path(__file__).with_name("parser_sentences.json")


@dataclass(frozen=True, slots=True)
class ParserScore:
    """Shares of correct sentences, milliseconds per sentence, and the texts whose graph is not exact.

    A share for each part of the graph as a set; relations with negation and distances. exact: all of them. opposites:
    the sentences without a warning whose graph states the opposite: a relation with the wrong negation, an object to
    leave alone that is handled or locates something, or an object to handle that is left alone.
    """

    sentences: int
    exact: float
    target_set: float
    role_set: float
    anchor_set: float
    relation_set: float
    attribute_set: float
    excluded_set: float
    opposites: tuple[str, ...]
    median_ms: float
    slowest_ms: float
    by_fallback: int
    wrong: tuple[str, ...]


def load_sentences(path: Path = SENTENCES) -> list[TaskGraph]:
    """Return the expected graphs, with their sentence as text, of a JSON file. Raises InvalidInputError, OSError.

    The file is a list of graphs in the form of `gausslite parse --json`, with the sentence as "text".
    """
    try:
        rows = json.loads(path.read_text(encoding="utf-8"))
        graphs = [graph_from_json({**row, "text": row["text"]}) for row in rows]
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        expected = "a list of text, targets, roles, anchors and relations as in docs/guides/task.md"
        raise InvalidInputError(f"{path}: expected {expected}, got other content ({error})") from error
    if not graphs:
        raise InvalidInputError(f"{path}: expected at least one sentence, got none")
    return graphs


def score_parser(
    parser: TaskParser, expected: Sequence[TaskGraph], clock_s: Callable[[], float] = time.perf_counter
) -> ParserScore:
    """Return the scores of parsing every sentence once; a sentence that raises TaskError counts as wrong."""
    matches: list[tuple[bool, ...]] = []
    times_ms: list[float] = []
    fallbacks = 0
    opposites: list[str] = []
    for graph in expected:
        started_s = clock_s()
        parsed = _graph_or_none(parser, graph.text)
        times_ms.append(1e3 * (clock_s() - started_s))
        matches.append(matching_parts(graph, parsed))
        if parsed is not None:
            fallbacks += any(warning.startswith("backend ") for warning in parsed.warnings)
            if not parsed.warnings and _is_opposite(graph, parsed):
                opposites.append(graph.text)
    exact = [all(parts) for parts in matches]
    targets, roles, anchors, relations, attributes, excluded = map(statistics.fmean, zip(*matches, strict=True))
    return ParserScore(
        sentences=len(matches),
        exact=statistics.fmean(exact),
        target_set=targets,
        role_set=roles,
        anchor_set=anchors,
        relation_set=relations,
        attribute_set=attributes,
        excluded_set=excluded,
        opposites=tuple(opposites),
        median_ms=statistics.median(times_ms),
        slowest_ms=max(times_ms),
        by_fallback=fallbacks,
        wrong=tuple(graph.text for graph, is_exact in zip(expected, exact, strict=True) if not is_exact),
    )


def matching_parts(expected: TaskGraph, parsed: TaskGraph | None) -> tuple[bool, ...]:
    """Return whether targets, roles, anchors, relations, attributes and excluded objects are equal as sets."""
    if parsed is None:
        return (False,) * 6
    return tuple(one == other for one, other in zip(_parts(expected), _parts(parsed), strict=True))


def _parts(graph: TaskGraph) -> tuple[frozenset[object], ...]:
    roles = zip(graph.targets, graph.roles, strict=True)
    parts = (graph.targets, roles, graph.anchors, graph.relations, graph.attributes, graph.excluded)
    return tuple(frozenset(part) for part in parts)


def _is_opposite(expected: TaskGraph, parsed: TaskGraph) -> bool:
    """Return True if the parsed graph states the opposite of a part of the expected one."""
    wanted = {
        (relation.predicate, relation.target, relation.anchor): relation.negated for relation in expected.relations
    }
    if any(
        wanted.get((relation.predicate, relation.target, relation.anchor), relation.negated) != relation.negated
        for relation in parsed.relations
    ):
        return True
    denied = _anchors(expected, negated=True) - _anchors(expected, negated=False) - _handled(expected)
    return bool(
        _handled(expected) & _left_alone(parsed)
        or _left_alone(expected) & _handled(parsed)
        or denied & (_handled(parsed) | _anchors(parsed, negated=False))
    )


def _handled(graph: TaskGraph) -> set[str]:
    return {target for target, role in zip(graph.targets, graph.roles, strict=True) if role is not TargetRole.OBSTACLE}


def _left_alone(graph: TaskGraph) -> set[str]:
    return {*graph.targets, *graph.excluded} - _handled(graph)


def _anchors(graph: TaskGraph, negated: bool) -> set[str]:
    return {relation.anchor for relation in graph.relations if relation.negated is negated}


def _graph_or_none(parser: TaskParser, text: str) -> TaskGraph | None:
    try:
        return parser.parse(text)
    except TaskError:
        return None
