"""Read the class names of a detector file: from its metadata in any text form, from a file beside it, or COCO's."""

from __future__ import annotations

import ast
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from gausslite.domain.errors import ModelFileError

_COCO: Final = """person, bicycle, car, motorcycle, airplane, bus, train, truck, boat, traffic light, fire hydrant,
stop sign, parking meter, bench, bird, cat, dog, horse, sheep, cow, elephant, bear, zebra, giraffe, backpack, umbrella,
handbag, tie, suitcase, frisbee, skis, snowboard, sports ball, kite, baseball bat, baseball glove, skateboard,
surfboard, tennis racket, bottle, wine glass, cup, fork, knife, spoon, bowl, banana, apple, sandwich, orange, broccoli,
carrot, hot dog, pizza, donut, cake, chair, couch, potted plant, bed, dining table, toilet, tv, laptop, mouse, remote,
keyboard, cell phone, microwave, oven, toaster, sink, refrigerator, book, clock, vase, scissors, teddy bear, hair drier,
toothbrush"""
COCO_NAMES: Final = tuple(" ".join(name.split()) for name in _COCO.split(","))
# the category ids of COCO run from 1 to 90 without these
_COCO_GAPS: Final = frozenset({12, 26, 29, 30, 45, 66, 68, 69, 71, 83})
_COCO_BY_ID: Final = dict(zip((i for i in range(1, 91) if i not in _COCO_GAPS), COCO_NAMES, strict=True))
_KEYS: Final = ("names", "class_names", "classes", "labels")
_INDEXED: Final = re.compile(r"(\d+)\s*([:=,\s])\s*(.+)")
_NOTES: Final = "rfdetr_notes"
"""The field in which `export(notes=...)` of rfdetr stores a text or JSON."""


def stated_names(path: Path, metadata: Mapping[str, str]) -> dict[int, str]:
    """Return the names by class index that the file or the text file beside it states, empty without any.

    Raises ModelFileError for names that cannot be read.
    """
    for key in _KEYS:
        if text := metadata.get(key, "").strip():
            names = _names_in(_parsed(text))
            if not names:
                raise ModelFileError(
                    f"model {path}: expected the class names in the metadata field {key!r} as a list or a dictionary, "
                    f"got {text[:40]!r}"
                )
            return names
    notes = _parsed(metadata.get(_NOTES, ""))
    if isinstance(notes, dict | list) and (names := _names_in(notes)):
        return names
    beside = names_file(path)
    if not beside.is_file():
        return {}
    try:
        text = beside.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise ModelFileError(f"{beside}: expected one class name per line, but {error}") from error
    return _names_in(_parsed(text, one_per_line=True))


def names_file(path: Path) -> Path:
    """Return the text file beside a model that may state its class names, one per line."""
    return path.with_suffix(".txt")


def class_count(stated: Mapping[int, str]) -> int:
    """Return the number of classes of names by index, which may be counted from 1; 0 without names."""
    if stated and sorted(stated) == list(range(1, len(stated) + 1)):
        return len(stated)
    return max(stated, default=-1) + 1


def names_of(stated: Mapping[int, str], classes: int) -> tuple[str, ...]:
    """Return a name for each class index, "" for an index without one; empty if the names do not fit.

    Without stated names, 80 and 91 classes are those of COCO, in its order and by its ids.
    """
    if classes == len(COCO_NAMES) + 11 and (not stated or tuple(stated.values()) == COCO_NAMES):
        stated = _COCO_BY_ID
    elif classes == len(COCO_NAMES) and not stated:
        stated = dict(enumerate(COCO_NAMES))
    if stated and max(stated) == classes and min(stated) >= 1:
        stated = {index - 1: name for index, name in stated.items()}
    if not stated or max(stated) >= classes or min(stated) < 0:
        return ()
    return tuple(stated.get(index, "") for index in range(classes))


def _parsed(text: str, one_per_line: bool = False) -> Any:
    """Return the value of JSON or of a Python literal; else the words of lines or a list, numbered ones by index."""
    for parse in (json.loads, ast.literal_eval):
        try:
            return parse(text)
        except (ValueError, SyntaxError, TypeError, MemoryError, RecursionError):
            continue
    if text.startswith(("{", "[", "(")):
        return None
    words = text.splitlines() if one_per_line or "\n" in text else text.replace(";", ",").split(",")
    words = [word.strip() for word in words if word.strip()]
    if words and words[0] in (f"{key}:" for key in _KEYS):  # YAML
        words = words[1:]
    if all(word.startswith("- ") for word in words):
        words = [word[2:].strip() for word in words]
    indexed = [entry for word in words if (entry := _INDEXED.fullmatch(word))]
    names = {int(entry[1]): entry[3].strip("'\"") for entry in indexed}
    # without a colon, the number may belong to the name: "5 cent coin"
    first = min(names, default=0)
    runs_on = first <= 1 and sorted(names) == list(range(first, first + len(words)))
    is_numbered = runs_on or all(entry[2] in ":=" for entry in indexed)
    return names if is_numbered and len(indexed) == len(words) else words


def _names_in(value: Any) -> dict[int, str]:
    """Return the names of a list, or of a dictionary by index or under the name of a field; empty for other values."""
    if isinstance(value, list | tuple) and all(isinstance(name, str) for name in value):
        return dict(enumerate(value))
    if not isinstance(value, dict):
        return {}
    for key in _KEYS:
        if key in value:
            return _names_in(value[key])
    for pairs in (value.items(), ((index, name) for name, index in value.items())):
        try:
            return {int(index): str(name) for index, name in pairs}
        except (ValueError, TypeError):
            continue
    return {}
