"""Read the plain values of options from flags, variables and TOML, check them, and write them as TOML."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping, Sequence
from enum import Enum
from pathlib import Path
from typing import Any, get_args, get_origin

from gausslite.domain.checks import require_instance, require_number, require_whole
from gausslite.domain.errors import InvalidInputError

Plain = str | bool | int | float | Sequence[str] | None
"""The value of one option in a configuration file; None leaves the option out."""
_BOOLEANS = {**dict.fromkeys(("1", "true", "yes", "on"), True), **dict.fromkeys(("0", "false", "no", "off"), False)}
_PASSWORDS = (
    re.compile(r"(://[^/@\s:]*:)[^/@\s]+(?=@)"),
    # of a database, also one with characters that a URL has to escape
    re.compile(r"(postgres(?:ql)?://[^/@\s:]*:)\S+(?=@)"),
    re.compile(r"([?&](?:ssl)?password=)[^&\s]+"),
)


def split_names(text: str) -> tuple[str, ...]:
    """Return the parts of "a,b" without surrounding spaces."""
    return tuple(part.strip() for part in text.split(",") if part.strip())


def read_plain(kind: Any, value: object, *, is_toml: bool = False) -> Any:
    """Return a value from text or, with is_toml, from TOML. Raises InvalidInputError without the option's name."""
    if kind is bool:
        return _read_bool(value, is_toml)
    if kind in (int, float):
        return _read_number(kind, value, is_toml)
    if get_origin(kind) in (tuple, frozenset):
        return _read_parts(kind, value)
    if not isinstance(value, str):
        raise InvalidInputError(f"expected text, got {value!r}")
    if isinstance(kind, type) and issubclass(kind, Enum):
        names = [str(member.value) for member in kind]
        if value not in names:
            raise InvalidInputError(f"expected one of {', '.join(names)}, got {value!r}")
        return kind(value)
    if kind is Path:
        if not value:
            raise InvalidInputError("expected a path, got an empty text")
        return Path(value)
    return value


def require_plain(
    name: str, value: object, kind: Any, low: float | None, high: float | None, unit: str, choices: Sequence[str]
) -> None:
    """Raise InvalidInputError unless a value has the type, lies within the bounds and is one of the choices."""
    if kind is int:
        require_whole(name, value)
    elif kind is float:
        require_number(name, value)
    elif get_origin(kind) is frozenset:
        require_instance(name, value, (frozenset, set), "a set of names such as frozenset({'sb'})")
    elif isinstance(kind, type):
        require_instance(name, value, kind, "text" if kind is str else f"a {kind.__name__}")
    if isinstance(value, int | float) and not isinstance(value, bool) and not is_within(value, low, high):
        raise InvalidInputError(f"{name}: expected {describe_range(low, high, unit)}, got {value}")
    if choices and value not in choices:
        raise InvalidInputError(f"{name}: expected one of {', '.join(choices)}, got {value!r}")


def is_within(value: float, low: float | None, high: float | None) -> bool:
    """Return True for a number between the bounds, both included; never for NaN."""
    return not math.isnan(value) and (low is None or value >= low) and (high is None or value <= high)


def describe_range(low: float | None, high: float | None, unit: str = "") -> str:
    """Return "0 to 10 s", "at least 1" or "at most 5"; empty without bounds."""
    if low is None and high is None:
        return ""
    text = f"{_number(low)} to {_number(high)}" if low is not None and high is not None else ""
    text = text or (f"at least {_number(low)}" if low is not None else f"at most {_number(high)}")
    return f"{text} {unit}".rstrip()


def without_password(text: str) -> str:
    """Return the text with "***" in place of a URL's password."""
    for pattern in _PASSWORDS:
        text = pattern.sub(r"\1***", text)
    return text


def to_toml(values: Mapping[str, Plain]) -> str:
    """Return one `key = value` line per value that is not None; `tomllib` reads it back."""
    return "".join(f"{key} = {_literal(value)}\n" for key, value in values.items() if value is not None)


def _read_bool(value: object, is_toml: bool) -> bool:
    if isinstance(value, bool):
        return value
    if isinstance(value, str) and not is_toml and value.lower() in _BOOLEANS:
        return _BOOLEANS[value.lower()]
    raise InvalidInputError(f"expected true or false, got {value!r}")


def _read_number(kind: type[int] | type[float], value: object, is_toml: bool) -> int | float:
    if is_toml:
        if isinstance(value, (int, float) if kind is float else int) and not isinstance(value, bool):
            return kind(value)
    elif isinstance(value, str):
        try:
            return kind(value)
        except ValueError:
            pass
    expected = "a whole number" if kind is int else "a number"
    raise InvalidInputError(f"expected {expected}, got {value!r}")


def _read_parts(kind: Any, value: object) -> Any:
    """Return the parts of "a,b" or of an array, with the type's element."""
    parts = split_names(value) if isinstance(value, str) else value
    if not isinstance(parts, list | tuple):
        raise InvalidInputError(f"expected a list of texts, got {value!r}")
    element = get_args(kind)[0]
    container: Any = get_origin(kind)
    return container(read_plain(element, part) for part in parts)


def _number(bound: float | None) -> str:
    return "" if bound is None else str(int(bound)) if bound == int(bound) else f"{bound:g}"


def _literal(value: str | bool | int | float | Sequence[str]) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, str):
        # JSON's escapes are TOML's, except that TOML refuses a bare DEL and lone surrogates
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    return f"[{', '.join(_literal(part) for part in value)}]"
