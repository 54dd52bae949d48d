"""Check names that come from outside: agents, missions and world frames."""

from __future__ import annotations

from gausslite.domain.errors import InvalidInputError

MAX_NAME_BYTES = 255
_MAX_QUOTED_CHARACTERS = 64


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


def quote_name(name: str) -> str:
    """Return the name quoted and shortened, for an error message."""
    return repr(name if len(name) <= _MAX_QUOTED_CHARACTERS else f"{name[:_MAX_QUOTED_CHARACTERS]}…")
