"""Write option values as TOML; `tomllib` reads it back."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence

OptionValue = str | bool | int | float | Sequence[str] | None
"""The value of one option in a configuration file; None leaves the option out."""


_PASSWORDS = (
    re.compile(r"(://[^/@\s:]*:)[^/@\s]+(?=@)"),
    # of a database, also one with characters that a URL has to escape
    re.compile(r"(postgres(?:ql)?://[^/@\s:]*:)\S+(?=@)"),
    re.compile(r"([?&](?:ssl)?password=)[^&\s]+"),
)


def without_password(text: str) -> str:
    """Return the text with "***" in place of a URL's password."""
    for pattern in _PASSWORDS:
        text = pattern.sub(r"\1***", text)
    return text


def to_toml(values: Mapping[str, OptionValue]) -> str:
    """Return one `key = value` line per value that is not None."""
    return "".join(f"{key} = {_literal(value)}\n" for key, value in values.items() if value is not None)


def _literal(value: str | bool | int | float | Sequence[str]) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, str):
        # JSON's escapes are TOML's, except that TOML refuses a bare DEL and lone surrogates
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    return f"[{', '.join(_literal(each) for each in value)}]"
