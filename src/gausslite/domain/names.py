"""Check names that come from outside: agents and missions (a safe alphabet), world frames and nouns (printable)."""

from __future__ import annotations

import re

from gausslite.domain.errors import InvalidInputError

MAX_NAME_BYTES = 255
MAX_IDENTIFIER_CHARACTERS = 64
_IDENTIFIER = re.compile(rf"[A-Za-z0-9][A-Za-z0-9._-]{{0,{MAX_IDENTIFIER_CHARACTERS - 1}}}")
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


def require_identifier(field: str, name: str) -> None:
    """Raise InvalidInputError unless the name is safe in logs, file names, labels and shells; empty is refused."""
    if not _IDENTIFIER.fullmatch(name):
        raise InvalidInputError(
            f"{field}: expected 1 to {MAX_IDENTIFIER_CHARACTERS} letters, digits and . _ -, beginning with a letter or "
            f"a digit, got {quote_name(name)}"
        )


def quote_name(name: str) -> str:
    """Return the name quoted and shortened, for an error message."""
    return repr(name if len(name) <= _MAX_QUOTED_CHARACTERS else f"{name[:_MAX_QUOTED_CHARACTERS]}…")
