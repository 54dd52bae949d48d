"""Check values that come from outside: arguments of the Python API, names of agents, missions, frames and nouns."""

from __future__ import annotations

import numbers
import re

from gausslite.domain.errors import InvalidInputError

MAX_NAME_BYTES = 255
MAX_IDENTIFIER_CHARACTERS = 64
_IDENTIFIER = re.compile(rf"[A-Za-z0-9][A-Za-z0-9._-]{{0,{MAX_IDENTIFIER_CHARACTERS - 1}}}")
_MAX_QUOTED_CHARACTERS = 64


def require_instance(name: str, value: object, kind: type | tuple[type, ...], expected: str) -> None:
    """Raise InvalidInputError unless the value has the type; expected: a description of the type, for the message."""
    if not isinstance(value, kind):
        raise InvalidInputError(f"{name}: expected {expected}, got {describe(value)}")


def require_types(**arguments: tuple[object, type | tuple[type, ...]]) -> None:
    """Raise InvalidInputError unless each argument, given by its name as value and type or types, has its type."""
    for name, (value, kind) in arguments.items():
        kinds = kind if isinstance(kind, tuple) else (kind,)
        require_instance(name, value, kind, " or ".join(option.__name__ for option in kinds))


def require_whole(name: str, value: object) -> None:
    """Raise InvalidInputError unless the value is a whole number; True and False are not numbers."""
    if isinstance(value, bool) or not isinstance(value, numbers.Integral):
        raise InvalidInputError(f"{name}: expected a whole number, got {describe(value)}")


def require_number(name: str, value: object) -> None:
    """Raise InvalidInputError unless the value is a real number; True and False are not numbers."""
    if isinstance(value, bool) or not isinstance(value, numbers.Real):
        raise InvalidInputError(f"{name}: expected a number, got {describe(value)}")


def require_size(name: str, value: object) -> None:
    """Raise InvalidInputError unless the value is (width, height), two whole numbers above 0."""
    sides = value if isinstance(value, tuple | list) else ()
    if len(sides) != 2 or not all(isinstance(side, numbers.Integral) and int(side) > 0 for side in sides):
        raise InvalidInputError(
            f"{name}: expected (width, height) in pixels as whole numbers such as (320, 240), got {describe(value)}"
        )


def describe(value: object) -> str:
    """Return a short text of a value for messages: its type and the start of its text."""
    text = repr(value)
    return f"{type(value).__name__} {text if len(text) <= 40 else text[:37] + '...'}"


def require_name(field: str, name: str) -> None:
    """Raise InvalidInputError unless the name is printable text of at most MAX_NAME_BYTES bytes; empty is allowed."""
    try:
        size = len(name.encode())
    except UnicodeEncodeError:
        raise InvalidInputError(f"{field}: expected UTF-8 text, got other bytes") from None
    if size > MAX_NAME_BYTES:
        raise InvalidInputError(f"{field}: expected at most {MAX_NAME_BYTES} bytes, got {size}")
    if not name.isprintable():
        raise InvalidInputError(f"{field}: expected no line breaks or control characters, got {quote_name(name)}")


def require_identifier(field: str, name: str) -> str:
    """Return the name. Raises InvalidInputError if it is empty or not safe in logs, file names, labels and shells."""
    if not _IDENTIFIER.fullmatch(name):
        raise InvalidInputError(
            f"{field}: expected 1 to {MAX_IDENTIFIER_CHARACTERS} letters, digits and . _ -, beginning with a letter or "
            f"a digit, got {quote_name(name)}"
        )
    return name


def quote_name(name: str) -> str:
    """Return the name quoted and shortened, for an error message."""
    return repr(name if len(name) <= _MAX_QUOTED_CHARACTERS else f"{name[:_MAX_QUOTED_CHARACTERS]}…")
