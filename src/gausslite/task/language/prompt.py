"""The prompt for language models: rules, examples, and the JSON schema of the answer."""

from __future__ import annotations

import json
from typing import Any, Final

from gausslite.domain.task import Predicate, TargetRole
from gausslite.task.language.model import Message, MessageRole

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
