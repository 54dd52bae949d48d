"""Size limits of tasks and task graphs, for every parser: rules, language model or remote."""

from __future__ import annotations

from dataclasses import dataclass

from gausslite.domain.errors import TaskError
from gausslite.domain.task import TaskGraph

EXAMPLE = "'Pick up the mug on the table'"


@dataclass(frozen=True, slots=True)
class TaskLimits:
    """Largest sizes of a task and its graph."""

    max_text_chars: int = 1000
    max_targets: int = 16
    max_anchors: int = 16
    max_phrase_chars: int = 64
    max_relations: int = 64
    max_warnings: int = 64


LIMITS = TaskLimits()


def require_task_text(text: str, limits: TaskLimits = LIMITS) -> None:
    """Raise TaskError unless the text is UTF-8, contains a letter and is short enough."""
    if len(text) > limits.max_text_chars:
        raise TaskError(f"task text: expected at most {limits.max_text_chars} characters, got {len(text)}")
    # surrogates: Python's form of bytes that are not UTF-8, which neither messages nor files can store
    if any("\ud800" <= character <= "\udfff" for character in text):
        raise TaskError(f"task text: expected UTF-8, got bytes of another encoding in {text.strip()!r}")
    if not any(character.isalpha() for character in text):
        raise TaskError(f"task text: expected a sentence that names an object, such as {EXAMPLE}, got {text.strip()!r}")


def require_graph(graph: TaskGraph, limits: TaskLimits = LIMITS) -> None:
    """Raise TaskError unless the graph is within the limits and its relations join listed nouns.

    The text is empty if the graph was not parsed from a sentence.
    """
    if graph.text:
        require_task_text(graph.text, limits)
    if not graph.targets:
        raise TaskError(f"task targets: expected at least one object, such as in {EXAMPLE}, got none")
    _require_phrases("targets", graph.targets, limits.max_targets, limits.max_phrase_chars)
    _require_phrases("anchors", graph.anchors, limits.max_anchors, limits.max_phrase_chars)
    if len(graph.relations) > limits.max_relations or len(graph.warnings) > limits.max_warnings:
        expected = f"{limits.max_relations} relations and {limits.max_warnings} warnings"
        raise TaskError(f"task: expected at most {expected}, got {len(graph.relations)} and {len(graph.warnings)}")
    for relation in graph.relations:
        if relation.target not in graph.targets:
            raise TaskError(f"task {relation.predicate}: expected one of the targets first, got {relation.target!r}")
        if relation.anchor not in graph.anchors:
            raise TaskError(f"task {relation.predicate}: expected one of the anchors last, got {relation.anchor!r}")


def _require_phrases(role: str, phrases: tuple[str, ...], max_count: int, max_chars: int) -> None:
    if len(phrases) > max_count:
        raise TaskError(f"task {role}: expected at most {max_count} objects, got {len(phrases)}")
    if len(set(phrases)) != len(phrases):
        raise TaskError(f"task {role}: expected each object once, got {', '.join(phrases)}")
    for phrase in phrases:
        if not phrase.strip() or phrase != phrase.strip() or not phrase.isprintable():
            raise TaskError(f"task {role}: expected printable phrases without outer spaces, got {phrase!r}")
        if len(phrase) > max_chars:
            raise TaskError(f"task {role}: expected phrases of at most {max_chars} characters, got {len(phrase)}")
