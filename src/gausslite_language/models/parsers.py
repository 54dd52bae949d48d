"""Task parsers around a language model: query it, cache its answers, and fall back to rules if it fails."""

from __future__ import annotations

import json
import logging
import threading
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any, Final, NoReturn, Protocol, runtime_checkable

from gausslite.domain.errors import LanguageModelError, TaskError
from gausslite.domain.task import (
    LIMITS,
    Predicate,
    Relation,
    TargetRole,
    TaskGraph,
    TaskParser,
    noun_of,
    require_task_text,
)
from gausslite_language.grounding import ParsedPhrases, grounded_graph
from gausslite_language.rules import RuleParser, lost_warning

MAX_ANSWER_BYTES = 64 * 1024


class MessageRole(StrEnum):
    """Author of a chat message."""

    SYSTEM = "system"
    USER = "user"
    ASSISTANT = "assistant"


@dataclass(frozen=True, slots=True)
class Message:
    """One message of a chat."""

    role: MessageRole
    text: str


@runtime_checkable
class LanguageModel(Protocol):
    """Complete a chat. Calls may take seconds and may come from several threads."""

    @property
    def version(self) -> str:
        """Identifies the model, so that cached answers of another model are not reused."""
        ...

    def complete(self, messages: Sequence[Message]) -> str:
        """Return the answer, at most MAX_ANSWER_BYTES long. Raises LanguageModelError."""
        ...


MAX_PHRASES: Final = 8
MAX_RELATIONS: Final = 16
MAX_PHRASE_CHARS: Final = 40
PROMPT_VERSION: Final = "2"

MAX_DISTANCE_M: Final = 1000.0
# one list of phrases for each role, and for what is no target
ROLE_KEYS: Final = {
    "targets": TargetRole.OBJECT,
    "destinations": TargetRole.DESTINATION,
    "tools": TargetRole.TOOL,
    "obstacles": TargetRole.OBSTACLE,
}
PHRASE_KEYS: Final = (*ROLE_KEYS, "anchors", "excluded", "context")

_PHRASE: Final = {"type": "string", "minLength": 1, "maxLength": MAX_PHRASE_CHARS}
_PHRASES: Final = {"type": "array", "maxItems": MAX_PHRASES, "items": _PHRASE}
_DISTANCE: Final = {"type": ["number", "null"], "minimum": 0, "maximum": MAX_DISTANCE_M}
ANSWER_SCHEMA: Final[dict[str, Any]] = {
    "type": "object",
    "additionalProperties": False,
    "required": [*PHRASE_KEYS, "relations"],
    "properties": {
        **dict.fromkeys(PHRASE_KEYS, _PHRASES),
        "relations": {
            "type": "array",
            "maxItems": MAX_RELATIONS,
            "items": {
                "type": "object",
                "additionalProperties": False,
                "required": ["predicate", "target", "anchor", "negated", "min_m", "max_m"],
                "properties": {
                    "predicate": {"enum": [str(predicate) for predicate in Predicate]},
                    "target": _PHRASE,
                    "anchor": _PHRASE,
                    "negated": {"type": "boolean"},
                    "min_m": _DISTANCE,
                    "max_m": _DISTANCE,
                },
            },
        },
    },
}

_RULES: Final = f"""You turn one task of a robot into JSON with the keys {", ".join(PHRASE_KEYS)}, relations.
targets: the objects the robot acts on, looks for or looks at.
destinations: where something is put, poured, hung, thrown or delivered, who receives it, where the robot goes.
tools: what the robot uses to act. obstacles: what it must not hit, touch, move or harm.
anchors: the objects that only say where one of these is now. Every anchor has a relation.
excluded: what the sentence says to ignore, to skip or not to act on.
context: rooms and places where things are. They are no anchors.
relations: {{"predicate", "target", "anchor", "negated", "min_m", "max_m"}}; predicate is one of {", ".join(Predicate)}.
A relation says where a target is now, not where it shall go. Say between once for each of its two anchors.
negated is true for "not on", "far from", "without". min_m and max_m bound the distance in metres, otherwise null.
Use the sentence's own nouns in the singular, with their adjectives and without articles. Add no other object.
A "this" or "it" without a noun is "object"."""


def _example(task: str, *relations: tuple[Any, ...], **phrases: list[str]) -> tuple[str, str]:
    """Return a task and its answer; a relation is a tuple of its fields, in their order."""
    names = ("predicate", "target", "anchor", "negated", "min_m", "max_m")
    defaults = ("near", "", "", False, None, None)
    rows = [dict(zip(names, (*row, *defaults[len(row) :]), strict=True)) for row in relations]
    answer = {key: phrases.get(key, []) for key in PHRASE_KEYS} | {"relations": rows}
    return task, json.dumps(answer, separators=(",", ":"))


_EXAMPLES: Final = (
    _example(
        "Prepare to pick up the object on the desk", ("on", "object", "desk"), targets=["object"], anchors=["desk"]
    ),
    _example(
        "Identify the largest chair closest to the table", ("closest_to", "largest chair", "table"),
        targets=["largest chair"], anchors=["table"],
    ),
    _example(
        "Bring the red cups in the sink to the man in the kitchen", ("inside", "red cup", "sink"),
        targets=["red cup"], destinations=["man"], anchors=["sink"], context=["kitchen"],
    ),
    _example(
        "Find the ball between the sofa and the lamp without touching the vase", ("between", "ball", "sofa"),
        ("between", "ball", "lamp"), targets=["ball"], obstacles=["vase"], anchors=["sofa", "lamp"],
    ),
    _example(
        "Wipe the screens that are not on the desk with a cloth, skip the phone", ("on", "screen", "desk", True),
        targets=["screen"], tools=["cloth"], anchors=["desk"], excluded=["phone"],
    ),
    _example(
        "Find the box within 2 m of the door", ("near", "box", "door", False, None, 2.0),
        targets=["box"], anchors=["door"],
    ),
    _example("Clean this up and drive to the door", targets=["object"], destinations=["door"]),
)  # fmt: skip


def messages_for(task: str) -> tuple[Message, ...]:
    """Return the chat for one task: the rules, the examples, the task."""
    examples = [
        message
        for question, answer in _EXAMPLES
        for message in (Message(MessageRole.USER, question), Message(MessageRole.ASSISTANT, answer))
    ]
    return (Message(MessageRole.SYSTEM, _RULES), *examples, Message(MessageRole.USER, " ".join(task.split())))


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
    return [_phrase(item) for item in value]


def _phrase(value: object) -> str:
    if not isinstance(value, str) or not 0 < len(value) <= MAX_PHRASE_CHARS or not value.isprintable():
        _refuse(f"expected printable phrases of up to {MAX_PHRASE_CHARS} characters, got something else")
    return value


def _relations(value: object) -> list[Relation]:
    if not isinstance(value, list) or len(value) > MAX_RELATIONS:
        _refuse(f"expected a list of at most {MAX_RELATIONS} relations, got something else")
    return [_relation(item) for item in value]


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


DEFAULT_CACHE_CAPACITY: Final = 256
_log: Final = logging.getLogger(__name__)


class LanguageParser:
    """A TaskParser that queries a language model. Its `parse` also raises LanguageModelError."""

    def __init__(self, model: LanguageModel) -> None:
        self._model = model

    @property
    def version(self) -> str:
        """The model's version and the prompt's."""
        return f"{self._model.version}, prompt {PROMPT_VERSION}"

    def parse(self, text: str) -> TaskGraph:
        """Return the model's graph, without nouns that the sentence does not mention."""
        require_task_text(text)
        return parse_answer(text, self._model.complete(messages_for(text)))


class AddingParser:
    """A TaskParser by rules, which queries a model only for nouns that the rules' graph lacks.

    The rules' graph stands; a warning marks each target that the model adds. `parse` also raises LanguageModelError.
    """

    def __init__(self, parser: LanguageParser, rules: RuleParser) -> None:
        self._parser, self._rules = parser, rules

    def parse(self, text: str) -> TaskGraph:
        """Return the graph of one task. Raises TaskError."""
        graph, lost = self._rules.parse_counting(text)
        return _with_lost_targets(graph, lost, self._parser.parse(text)) if lost else graph


def _with_lost_targets(graph: TaskGraph, lost: Sequence[str], answer: TaskGraph) -> TaskGraph:
    """Return the graph with the targets of an answer whose nouns it has lost, with their colours and superlatives."""
    heads = {name: noun_of(name).split()[-1] for name in answer.targets}
    roles = dict(zip(answer.targets, answer.roles, strict=True))
    added = [name for name, head in heads.items() if head in lost][: LIMITS.max_targets - len(graph.targets)]
    solved = {lost_warning(heads[name]) for name in added}
    marks = (f"{name!r} was added by the language model" for name in added)
    return replace(
        graph,
        targets=(*graph.targets, *added),
        roles=(*graph.roles, *(roles[name] for name in added)),
        attributes=(*graph.attributes, *(attribute for attribute in answer.attributes if attribute.name in added)),
        warnings=(*(warning for warning in graph.warnings if warning not in solved), *marks)[: LIMITS.max_warnings],
    )


class CachedParser:
    """A TaskParser with an LRU cache by task text, backend and version; failures are not cached."""

    def __init__(self, parser: TaskParser, backend: str, version: str, capacity: int = DEFAULT_CACHE_CAPACITY) -> None:
        self._parser = parser
        self._source = (backend, version)
        self._capacity = capacity
        self._lock = threading.Lock()
        self._answers: OrderedDict[tuple[str, str, str], TaskGraph] = OrderedDict()

    def parse(self, text: str) -> TaskGraph:
        """Return the graph of one task, from the cache if it is there."""
        key = (text, *self._source)
        with self._lock:
            cached = self._answers.get(key)
            if cached is not None:
                self._answers.move_to_end(key)
                return cached
        graph = self._parser.parse(text)
        with self._lock:
            self._answers[key] = graph
            while len(self._answers) > self._capacity:
                self._answers.popitem(last=False)
        return graph


class FallbackParser:
    """A TaskParser that uses another parser if the language model fails, and adds a warning."""

    def __init__(self, parser: TaskParser, backend: str, fallback: TaskParser) -> None:
        self._parser = parser
        self._backend = backend
        self._fallback = fallback

    def parse(self, text: str) -> TaskGraph:
        """Return the graph of one task. Raises TaskError."""
        try:
            return self._parser.parse(text)
        except LanguageModelError as error:
            _log.info("%s: %s; parsed by rules", self._backend, error)
            warning = f"backend {self._backend} failed ({error}): parsed by rules"
        graph = self._fallback.parse(text)
        return replace(graph, warnings=(warning, *graph.warnings)[: LIMITS.max_warnings])
