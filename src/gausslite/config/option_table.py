"""List the options of a parser by name, and convert their values from text."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gausslite.config.numbers import Number
from gausslite.config.toml_text import OptionValue
from gausslite.config.values import read_names
from gausslite.domain.errors import GaussLiteError, InvalidInputError

RawValue = str | bool | list[str]
"""An option's value before conversion: text, a switch, or the texts of a repeatable option."""
_NOT_CONFIGURABLE = frozenset({"help", "version", "config", "print_config"})


@dataclass(frozen=True, slots=True)
class OptionTable:
    """The configurable options of one parser, by argparse's `dest`."""

    actions: Mapping[str, argparse.Action]
    exclusive_groups: Sequence[frozenset[str]]

    @classmethod
    def of(cls, parser: argparse.ArgumentParser) -> OptionTable:
        """Return the table of a parser. argparse has no public list of its actions and groups."""
        actions = {action.dest: action for action in parser._actions if action.dest not in _NOT_CONFIGURABLE}
        groups = [
            frozenset(action.dest for action in group._group_actions) for group in parser._mutually_exclusive_groups
        ]
        return cls(actions, groups)

    def key(self, dest: str) -> str:
        """Return the option's name in a configuration file: the flag's, without the dashes in front."""
        flags = self.actions[dest].option_strings
        return flags[0].lstrip("-") if flags else dest.replace("_", "-")

    def exclusive_with(self, dest: str) -> frozenset[str]:
        """Return the options that cannot be set together with this one."""
        return frozenset().union(*(group - {dest} for group in self.exclusive_groups if dest in group))

    def is_switch(self, dest: str) -> bool:
        """Return True for an option without a value."""
        return self.actions[dest].nargs == 0

    def is_repeatable(self, dest: str) -> bool:
        """Return True for an option whose value is a list."""
        action = self.actions[dest]
        return isinstance(action, argparse._AppendAction) or action.nargs in ("*", "+")

    def convert(self, values: Mapping[str, RawValue], origins: Mapping[str, str]) -> dict[str, object]:
        """Return the converted values of the options that have an origin. Raises InvalidInputError that names it."""
        return {dest: self._convert(dest, values[dest], origin) for dest, origin in origins.items()}

    def file_value(self, dest: str, value: RawValue) -> OptionValue:
        """Return a valid raw value with the type that a configuration file gives it."""
        kind = number_kind(self.actions[dest])
        return kind(value) if isinstance(value, str) and kind is not None else value

    def default_value(self, dest: str) -> OptionValue:
        """Return the option's default as a configuration file states it, None if there is none."""
        default = self.actions[dest].default
        if default is None or isinstance(default, bool | int | float):
            return default
        if isinstance(default, str | Path):
            return str(default)
        if isinstance(default, list | tuple):
            plain = all(isinstance(each, str | int | float) for each in default)
            return ",".join(map(str, default)) or None if plain else None
        return str(default)

    def _convert(self, dest: str, value: RawValue, origin: str) -> object:
        if isinstance(value, bool):
            return value
        if isinstance(value, list):
            return [self._convert_text(dest, each, origin) for each in value]
        return self._convert_text(dest, value, origin)

    def _convert_text(self, dest: str, text: str, origin: str) -> object:
        action = self.actions[dest]
        convert: Callable[[str], Any] = str if action.type is None else action.type  # type: ignore[assignment]
        try:
            value = convert(text)
        except (argparse.ArgumentTypeError, GaussLiteError) as error:
            raise InvalidInputError(f"{origin}: {str(error).removeprefix(f'--{self.key(dest)}: ')}") from None
        except (TypeError, ValueError):
            raise InvalidInputError(f"{origin}: expected {type_name(action)}, got {text!r}") from None
        if action.choices is not None and value not in action.choices:
            raise InvalidInputError(f"{origin}: expected one of {', '.join(map(str, action.choices))}, got {text!r}")
        return value


@dataclass(frozen=True, slots=True)
class Layer:
    """Option values from one place by `dest`, and how messages name each of them."""

    values: Mapping[str, RawValue]
    origins: Mapping[str, str]


def variable_name(key: str) -> str:
    """Return the environment variable of an option: GAUSSLITE_MAX_GAUSSIANS for max-gaussians."""
    return f"GAUSSLITE_{key.replace('-', '_').upper()}"


def type_name(action: argparse.Action) -> str:
    """Return a description of the values that an option accepts, for error messages."""
    kind = number_kind(action)
    if kind is not None:
        return "a whole number" if kind is int else "a number"
    return f"text such as {action.metavar}" if action.metavar else "text"


def number_kind(action: argparse.Action) -> type[int] | type[float] | None:
    """Return int or float for a numeric option, None for any other."""
    if isinstance(action.type, Number):
        return action.type.kind
    if action.type is int:
        return int
    return float if action.type is float else None


def accepts_list(action: argparse.Action) -> bool:
    """Return True if the option's text is a list with commas, which a file may also write as an array."""
    return action.type is read_names or (isinstance(action.metavar, str) and "," in action.metavar)
