"""Convert settings dataclasses to plain JSON values and back, for checkpoints."""

from __future__ import annotations

import types
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from pathlib import Path
from typing import Any, Union, get_args, get_origin, get_type_hints

from gausslite.domain.errors import InvalidInputError


def to_plain(value: object) -> Any:
    """Return settings as JSON values, sets sorted, paths and enums as text. Raises TypeError for other types."""
    if is_dataclass(value) and not isinstance(value, type):
        return {field.name: to_plain(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, Enum):
        return to_plain(value.value)
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, set | frozenset):
        return sorted(to_plain(item) for item in value)
    if isinstance(value, tuple | list):
        return [to_plain(item) for item in value]
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise TypeError(f"settings: expected plain values, got {type(value).__name__}")


def field_from_plain(kind: type, name: str, value: object) -> Any:
    """Return one field of a settings class from the value that `to_plain` made.

    Missing fields of a nested class get their default. Raises InvalidInputError for unknown fields, other types and
    invalid values.
    """
    return _convert(get_type_hints(kind)[name], value, f"{kind.__name__}.{name}")


def _convert(kind: Any, value: Any, name: str) -> Any:
    origin = get_origin(kind)
    if origin in (Union, types.UnionType):
        return _convert_union(get_args(kind), value, name)
    if is_dataclass(kind):
        return _convert_dataclass(kind, value, name)
    if origin in (tuple, frozenset):
        return _convert_sequence(origin, get_args(kind), value, name)
    if kind is float and type(value) in (int, float):
        return float(value)
    if kind is type(None) or kind in (bool, int, str):
        if type(value) is kind:
            return value
    elif isinstance(kind, type) and issubclass(kind, Enum | Path) and isinstance(value, str):
        try:
            return kind(value)
        except ValueError:
            pass
    raise InvalidInputError(f"{name}: expected {getattr(kind, '__name__', kind)}, got {value!r:.80}")


def _convert_union(kinds: tuple[Any, ...], value: Any, name: str) -> Any:
    if value is None and type(None) in kinds:
        return None
    [kind] = [given for given in kinds if given is not type(None)]
    return _convert(kind, value, name)


def _convert_dataclass(kind: Any, value: Any, name: str) -> Any:
    if not isinstance(value, Mapping):
        raise InvalidInputError(f"{name}: expected an object, got {value!r:.80}")
    hints = get_type_hints(kind)
    known = {field.name for field in fields(kind)}
    unknown = sorted(str(key) for key in value.keys() - known)
    if unknown:
        raise InvalidInputError(f"{name}: expected fields among {', '.join(sorted(known))}, got {', '.join(unknown)}")
    try:
        return kind(**{key: _convert(hints[key], item, f"{name}.{key}") for key, item in value.items()})
    except TypeError as error:
        raise InvalidInputError(f"{name}: {error}") from None


def _convert_sequence(origin: Any, kinds: tuple[Any, ...], value: Any, name: str) -> Any:
    if not isinstance(value, list):
        raise InvalidInputError(f"{name}: expected a list, got {value!r:.80}")
    if origin is frozenset or kinds[-1] is Ellipsis:
        kinds = (kinds[0],) * len(value)
    if len(kinds) != len(value):
        raise InvalidInputError(f"{name}: expected {len(kinds)} values, got {len(value)}")
    return origin(_convert(kind, item, f"{name}[{i}]") for i, (kind, item) in enumerate(zip(kinds, value, strict=True)))
