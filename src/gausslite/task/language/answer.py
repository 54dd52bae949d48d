"""Parse and validate the answer of a language model."""

from __future__ import annotations

import json
from typing import Any, Final, NoReturn

from gausslite.domain.errors import LanguageModelError, TaskError
from gausslite.domain.task import Predicate, Relation, TargetRole, TaskGraph
from gausslite.task.graph_grounding import ParsedPhrases, grounded_graph
from gausslite.task.language.model import MAX_ANSWER_BYTES
from gausslite.task.language.prompt import (
    MAX_DISTANCE_M,
    MAX_PHRASE_CHARS,
    MAX_PHRASES,
    MAX_RELATIONS,
    PHRASE_KEYS,
    ROLE_KEYS,
)

# other keys of the schema may be missing in answers of servers that do not enforce it
_REQUIRED_KEYS: Final = frozenset({"targets", "anchors", "relations"})
_KEYS: Final = frozenset({*PHRASE_KEYS, "relations"})
_REQUIRED_RELATION_KEYS: Final = frozenset({"predicate", "target", "anchor"})
_RELATION_KEYS: Final = _REQUIRED_RELATION_KEYS | {"negated", "min_m", "max_m"}


def parse_answer(task: str, answer: str) -> TaskGraph:
    """Return the task graph of a model's answer: JSON by ANSWER_SCHEMA, possibly inside other text.

    Raises LanguageModelError if the answer violates the schema or contains no target that the task names.
    """
    fields = _first_object(answer)
    if not _REQUIRED_KEYS <= fields.keys() <= _KEYS:
        _refuse(f"expected the keys {', '.join(sorted(_KEYS))}, got {len(fields)} others")
    phrases = {key: _phrases(key, fields.get(key, [])) for key in PHRASE_KEYS}
    roles: dict[str, TargetRole] = {}
    for key, role in ROLE_KEYS.items():
        for phrase in phrases[key]:
            roles.setdefault(phrase, role)
    parsed = ParsedPhrases(
        targets=roles,
        anchors=phrases["anchors"],
        relations=_relations(fields["relations"]),
        excluded=phrases["excluded"],
        context=phrases["context"],
    )
    try:
        return grounded_graph(task, parsed)
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
    if (
        not isinstance(value, dict)
        or not _REQUIRED_RELATION_KEYS <= value.keys() <= _RELATION_KEYS
        or value["predicate"] not in list(Predicate)
        or not isinstance(value.get("negated", False), bool)
    ):
        _refuse(f"expected relations of {', '.join(sorted(_RELATION_KEYS))} with a known predicate, got something else")
    return Relation(
        Predicate(value["predicate"]),
        _phrase(value["target"]),
        _phrase(value["anchor"]),
        value.get("negated", False),
        _distance_m(value.get("min_m")),
        _distance_m(value.get("max_m")),
    )


def _distance_m(value: object) -> float | None:
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value <= MAX_DISTANCE_M:
        _refuse(f"expected distances of 0 to {MAX_DISTANCE_M:g} m, got something else")
    return round(float(value), 2)


def _refuse(problem: str) -> NoReturn:
    raise LanguageModelError(f"language model answer: {problem}")
