"""The prompt for language models: rules, examples, and the JSON schema of the answer."""

from __future__ import annotations

import json
from typing import Any, Final

from gausslite.domain.task import Predicate
from gausslite.task.language.model import Message, Role

MAX_PHRASES: Final = 8
MAX_RELATIONS: Final = 16
MAX_PHRASE_CHARS: Final = 40
PROMPT_VERSION: Final = "1"

_PHRASE: Final = {"type": "string", "minLength": 1, "maxLength": MAX_PHRASE_CHARS}
ANSWER_SCHEMA: Final[dict[str, Any]] = {
    "type": "object",
    "additionalProperties": False,
    "required": ["targets", "anchors", "relations"],
    "properties": {
        "targets": {"type": "array", "minItems": 1, "maxItems": MAX_PHRASES, "items": _PHRASE},
        "anchors": {"type": "array", "maxItems": MAX_PHRASES, "items": _PHRASE},
        "relations": {
            "type": "array",
            "maxItems": MAX_RELATIONS,
            "items": {
                "type": "object",
                "additionalProperties": False,
                "required": ["predicate", "target", "anchor"],
                "properties": {
                    "predicate": {"enum": [str(predicate) for predicate in Predicate]},
                    "target": _PHRASE,
                    "anchor": _PHRASE,
                },
            },
        },
    },
}

_RULES: Final = f"""You turn one task of a robot into JSON: {{"targets": [], "anchors": [], "relations": []}}.
targets: the objects the robot acts on, looks for, goes to or has to avoid.
anchors: the objects that only say where a target is or where it shall go.
relations: {{"predicate", "target", "anchor"}}; predicate is one of {", ".join(Predicate)}.
A relation says where a target is now, not where it shall go. Say between once for each of its two anchors.
Use the sentence's own nouns in the singular, with their adjectives and without articles. Add no other object.
What the robot shall leave alone is left out. A "this" or "it" without a noun is "object"."""


def _example(task: str, targets: list[str], anchors: list[str], *relations: tuple[str, str, str]) -> tuple[str, str]:
    rows = [{"predicate": predicate, "target": target, "anchor": anchor} for predicate, target, anchor in relations]
    return task, json.dumps({"targets": targets, "anchors": anchors, "relations": rows}, separators=(",", ":"))


_EXAMPLES: Final = (
    _example("Prepare to pick up the object on the desk", ["object"], ["desk"], ("on", "object", "desk")),
    _example("Identify the chair closest to the table", ["chair"], ["table"], ("closest_to", "chair", "table")),
    _example("Bring the red cups in the sink to the man", ["red cup"], ["sink", "man"], ("inside", "red cup", "sink")),
    _example(
        "Find the ball between the sofa and the lamp without touching the vase", ["ball"], ["sofa", "lamp"],
        ("between", "ball", "sofa"), ("between", "ball", "lamp"),
    ),
    _example("Clean this up and drive to the door", ["object", "door"], []),
)  # fmt: skip


def messages_for(task: str) -> tuple[Message, ...]:
    """Return the chat for one task: the rules, the examples, the task."""
    examples = [
        message
        for question, answer in _EXAMPLES
        for message in (Message(Role.USER, question), Message(Role.ASSISTANT, answer))
    ]
    return (Message(Role.SYSTEM, _RULES), *examples, Message(Role.USER, " ".join(task.split())))
