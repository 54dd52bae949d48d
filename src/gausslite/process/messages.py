"""Write messages to stderr: one line each, without control characters."""

from __future__ import annotations

import sys


def printable(text: str) -> str:
    """Return the text with control characters and bytes of other encodings escaped.

    File names and texts of users can contain them; a terminal would execute escape sequences.
    """
    return "".join(
        character if character.isprintable() else character.encode("unicode_escape").decode() for character in text
    )


def print_message(text: str) -> None:
    """Print one line on stderr."""
    print(printable(text), file=sys.stderr)
