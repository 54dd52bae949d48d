"""Declare an option as a field of a settings class: its unit, range, help and what it depends on."""

from __future__ import annotations

import difflib
import types
from argparse import Namespace
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import MISSING, dataclass, field, fields, is_dataclass
from enum import Enum
from functools import cache
from typing import Any, TypeVar, Union, cast, get_args, get_origin, get_type_hints

from gausslite.config.plain_values import Plain, require_plain
from gausslite.domain.checks import require_instance

_OPTION = "option"
Settings = TypeVar("Settings")
_MIN_SIMILARITY = 0.75


@dataclass(frozen=True, slots=True, kw_only=True)
class Option:
    """What is declared of an option beside the name, type and default of its field.

    low, high: bounds of a number, both included; needs: the option without which this one has no effect, as "detector",
    or with the value that it must have, as "backend=onnx|http".

    plain_type: the type in files and flags, if it is not the field's; convert returns the field's value from it, and
    to_plain the reverse.
    """

    help: str
    key: str = ""  # its name in files; by default the field's, with dashes
    metavar: str = ""
    unit: str = ""  # its unit
    low: float | None = None
    high: float | None = None
    choices: tuple[str, ...] = ()  # the accepted texts
    needs: str = ""
    excludes: str = ""  # the option that this one replaces
    computed: Callable[[Namespace], Any] | None = None  # returns the value that is used if none is set
    repeats: bool = False  # a list whose parts may contain commas; its flag may be repeated
    plain_type: Any = None
    convert: Callable[[Any], Any] | None = None
    to_plain: Callable[[Any], Any] | None = None


def option(default: Any, help_text: str, *, metadata: Mapping[str, Any] | None = None, **declared: Any) -> Any:
    """Return a dataclass field that is an option; default is MISSING for a required one. declared: see `Option`."""
    return field(default=default, metadata={_OPTION: Option(help=help_text, **declared), **(metadata or {})})


@dataclass(frozen=True, slots=True)
class OptionField:
    """An option with its field."""

    key: str
    field_name: str
    field_type: Any  # as the class declares it
    plain_type: Any  # the type in files and flags, without None
    default: Any
    option: Option

    @property
    def dest(self) -> str:
        """The name of the option's value among the options of a program."""
        return self.key.replace("-", "_")

    def to_plain(self, value: Any) -> Any:
        """Return a value of the field as a value of a file."""
        return value if value is None or self.option.to_plain is None else self.option.to_plain(value)


def option_key(settings_class: type, field_name: str) -> str:
    """Return the key of a field's option; of another field, its name with dashes."""
    declared = {item.name: item.metadata.get(_OPTION) for item in fields(settings_class)}
    found = declared.get(field_name)
    return (found.key if found is not None else "") or field_name.replace("_", "-")


@cache
def options_of(settings_class: Any) -> Mapping[str, OptionField]:
    """Return the options of a settings class and of its sections by key, in the order of their fields."""
    found: dict[str, OptionField] = {}
    for name, field_type, declared, default in _fields_of(settings_class):
        if declared is not None:
            key = declared.key or name.replace("_", "-")
            plain_type = field_type if declared.plain_type is None else declared.plain_type
            found[key] = OptionField(key, name, field_type, plain_type, default, declared)
        elif is_dataclass(field_type) and isinstance(field_type, type):
            for key, section_option in options_of(field_type).items():
                found.setdefault(key, section_option)
    return found


def build(settings_class: type[Settings], options: Namespace, **given: Any) -> Settings:
    """Return the settings of these options; `given` has the values of fields that are no option's."""
    for name, field_type, declared, _ in _fields_of(cast(Any, settings_class)):
        if name in given:
            continue
        if declared is not None:
            given[name] = getattr(options, (declared.key or name).replace("-", "_"))
        elif is_dataclass(field_type) and isinstance(field_type, type) and options_of(cast(Any, field_type)):
            given[name] = build(field_type, options)
    return settings_class(**given)


def plain_options(settings: Any) -> dict[str, Plain]:
    """Return the values of a file from which `build` makes these settings."""
    plain: dict[str, Plain] = {}
    for name, _, declared, _ in _fields_of(cast(Any, type(settings))):
        value = getattr(settings, name)
        if declared is not None:
            key = declared.key or name.replace("_", "-")
            plain[key] = as_plain(options_of(cast(Any, type(settings)))[key].to_plain(value))
        elif is_dataclass(value):
            plain |= plain_options(value)
    return plain


def as_plain(value: Any) -> Plain:
    """Return a value as TOML writes it: enums and paths as text, sets and tuples as lists."""
    if isinstance(value, Enum):
        return str(value.value)
    if isinstance(value, frozenset | tuple | list):
        parts = [str(as_plain(part)) for part in value]
        return sorted(parts) if isinstance(value, frozenset) else parts
    return value if value is None or isinstance(value, bool | int | float | str) else str(value)


def check_options(settings: Any) -> None:
    """Raise InvalidInputError for a field whose type, range or choice is not that of its option."""
    for name, field_type, declared, default in _fields_of(cast(Any, type(settings))):
        value = getattr(settings, name)
        if declared is None or (value is None and default is None):
            continue
        if declared.convert is None:
            require_plain(
                name, value, field_type, declared.low, declared.high, unit=declared.unit, choices=declared.choices
            )
        elif isinstance(field_type, type):
            require_instance(name, value, field_type, f"a {field_type.__name__}")


@cache
def _fields_of(settings_class: Any) -> tuple[tuple[str, Any, Option | None, Any], ...]:
    """Return name, type without None, declaration and default of each field of a dataclass."""
    return tuple(_described_fields(settings_class))


def _described_fields(settings_class: Any) -> Iterator[tuple[str, Any, Option | None, Any]]:
    hints = get_type_hints(settings_class)
    for item in fields(settings_class):
        if not item.init:
            continue
        default = item.default if item.default_factory is MISSING else item.default_factory()
        yield item.name, _without_none(hints[item.name]), item.metadata.get(_OPTION), default


def _without_none(kind: Any) -> Any:
    if get_origin(kind) in (Union, types.UnionType):
        kinds = [part for part in get_args(kind) if part is not type(None)]
        return kinds[0] if len(kinds) == 1 else kind
    return kind


def nearest(name: str, known: Iterable[str]) -> str | None:
    """Return the most similar known name, None if none is similar."""
    similar = difflib.get_close_matches(name, list(known), n=1, cutoff=_MIN_SIMILARITY)
    return similar[0] if similar else None


def suggestion(name: str, known: Iterable[str]) -> str:
    """Return "; did you mean NAME?" for the most similar known name, or an empty text if none is similar."""
    similar = nearest(name, known)
    return f"; did you mean {similar}?" if similar is not None else ""
