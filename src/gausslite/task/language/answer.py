"""Parse and validate the answer of a language model."""

from __future__ import annotations

import json
from typing import Any, Final, NoReturn

from gausslite.domain.errors import LanguageModelError, TaskError
from gausslite.domain.task import Predicate, Relation, TaskGraph
from gausslite.task.graph_grounding import grounded_graph
from gausslite.task.language.model import MAX_ANSWER_BYTES
from gausslite.task.language.prompt import MAX_PHRASE_CHARS, MAX_PHRASES, MAX_RELATIONS

_KEYS: Final = frozenset({"targets", "anchors", "relations"})
_RELATION_KEYS: Final = frozenset({"predicate", "target", "anchor"})


def parse_answer(task: str, answer: str) -> TaskGraph:
    """Return the task graph of a model's answer: JSON by ANSWER_SCHEMA, possibly inside other text.

    Raises LanguageModelError if the answer violates the schema or contains no target that the task names.
    """
    fields = _first_object(answer)
    if fields.keys() != _KEYS:
        _refuse(f"expected the keys {', '.join(sorted(_KEYS))}, got {len(fields)} others")
    targets, anchors = (_phrases(role, fields[role]) for role in ("targets", "anchors"))
    try:
        return grounded_graph(task, targets, anchors, _relations(fields["relations"]))
    except TaskError as error:
        raise LanguageModelError(f"language model: {error}") from error


def _first_object(answer: str) -> dict[str, Any]:
    """Return the first JSON object of a text; models often write an introduction before it."""
    if len(answer) > MAX_ANSWER_BYTES:
        _refuse(f"expected at most {MAX_ANSWER_BYTES} characters, got {len(answer)}")
    start = answer.find("{")
    if start < 0:
        _refuse("expected a JSON object, got none")
    try:
        fields, _ = json.JSONDecoder().raw_decode(answer[start:])
    except (ValueError, RecursionError) as error:
        raise LanguageModelError("language model answer: expected a complete JSON object, got invalid JSON") from error
    return dict(fields)


def _phrases(role: str, value: object) -> list[str]:
    if not isinstance(value, list) or len(value) > MAX_PHRASES:
        _refuse(f"expected a list of at most {MAX_PHRASES} {role}, got something else")
    return [_phrase(each) for each in value]


def _phrase(value: object) -> str:
    if not isinstance(value, str) or not 0 < len(value) <= MAX_PHRASE_CHARS or not value.isprintable():
        _refuse(f"expected printable phrases of up to {MAX_PHRASE_CHARS} characters, got something else")
    return value


def _relations(value: object) -> list[Relation]:
    if not isinstance(value, list) or len(value) > MAX_RELATIONS:
        _refuse(f"expected a list of at most {MAX_RELATIONS} relations, got something else")
    return [_relation(each) for each in value]


def _relation(value: object) -> Relation:
    if not isinstance(value, dict) or value.keys() != _RELATION_KEYS or value["predicate"] not in list(Predicate):
        _refuse(f"expected relations of {', '.join(sorted(_RELATION_KEYS))} with a known predicate, got something else")
    return Relation(Predicate(value["predicate"]), _phrase(value["target"]), _phrase(value["anchor"]))


def _refuse(problem: str) -> NoReturn:
    raise LanguageModelError(f"language model answer: {problem}")
