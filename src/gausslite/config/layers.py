"""Combine the option values of a program from flags, environment, a configuration file and a preset.

Flags override environment variables, those override the file, and the file overrides the preset. An option of a
mutually exclusive group replaces the group's options of lower layers.
"""

from __future__ import annotations

import argparse
import copy
import os
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from gausslite.config.environment import CONFIG_VARIABLE, describe_unknown_variables, read_environment
from gausslite.config.file import read_file
from gausslite.config.option_table import Layer, OptionTable, RawValue
from gausslite.config.presets import PRESETS
from gausslite.config.switches import dependent_default
from gausslite.config.toml_text import OptionValue, to_toml, without_password
from gausslite.domain.errors import InvalidInputError

_NEGATIVE_NUMBERS = re.compile(r"-\.?\d[\d.,eE+-]*$")
_PATHS_AS_TEXT = frozenset({"source"})


def parse_options(
    parser: argparse.ArgumentParser,
    arguments: Sequence[str] | None = None,
    environment: Mapping[str, str] | None = None,
    *,
    warn: Callable[[str], None],
) -> argparse.Namespace:
    """Return the effective options of a program; adds --config and --print-config to its parser.

    warn: called with one line for every environment variable that looks like an option but is none.

    A parser with sub-commands gets them in its chosen sub-command. Ends the process with code 0 after --print-config
    and with code 2 for wrong flags. Raises InvalidInputError for wrong values in the file or the environment.
    """
    parser, arguments = leaf_parser(parser, list(sys.argv[1:] if arguments is None else arguments))
    environment = os.environ if environment is None else environment
    if subcommands(parser) is not None:
        return parser.parse_args(arguments)
    add_configuration(parser)
    # values such as -1,0,0 are no flags
    parser._negative_number_matcher = _NEGATIVE_NUMBERS
    table = OptionTable.of(parser)
    flags = _parse_flags(parser, arguments)
    path = flags.pop("config", None) or environment.get(CONFIG_VARIABLE)
    print_only = bool(flags.pop("print_config", False))
    layers = [read_environment(table, environment)]
    if path:
        layers.append(read_file(table, Path(str(path))))
    values, origins = _combine(table, flags, layers)
    values, origins = _combine(table, values, [_read_preset(table, values.get("preset"))], origins)
    _require_paths(table, values)
    options = _parse_with_defaults(parser, arguments, table.convert(values, origins), print_only)
    keys = [table.key(dest) for dest in table.actions]
    for message in describe_unknown_variables(keys, environment, getattr(options, "llm_key_variable", None)):
        warn(f"{parser.prog}: {message}")
    if print_only:
        print(_configuration_text(parser.prog, table, values, options), end="")
        raise SystemExit(0)
    return options


def leaf_parser(
    parser: argparse.ArgumentParser, arguments: Sequence[str]
) -> tuple[argparse.ArgumentParser, Sequence[str]]:
    """Return the parser of the chosen sub-command and the arguments after the command's name."""
    commands = subcommands(parser)
    if commands is None or not arguments or arguments[0] not in commands:
        return parser, arguments
    return leaf_parser(commands[arguments[0]], arguments[1:])


def subcommands(parser: argparse.ArgumentParser) -> Mapping[str, argparse.ArgumentParser] | None:
    """Return the parsers of the sub-commands by name; None for a parser without sub-commands."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            choices: Mapping[str, argparse.ArgumentParser] = action.choices
            return choices
    return None


def add_configuration(parser: argparse.ArgumentParser) -> None:
    """Add --config and --print-config."""
    add = parser.add_argument_group("configuration").add_argument
    add(
        "--config",
        metavar="FILE.toml",
        type=Path,
        help="read options from this file, named as here without dashes in front; environment variables such as "
        "GAUSSLITE_MAX_GAUSSIANS override the file, flags override both",
    )
    add("--print-config", action="store_true", help="print the effective options as TOML for --config, and exit")


def _parse_flags(parser: argparse.ArgumentParser, arguments: Sequence[str]) -> dict[str, RawValue]:
    """Return the unconverted values of the options that the command line sets."""
    bare = _delegating_copy(parser)
    for action in bare._actions:
        action.default, action.type, action.choices = argparse.SUPPRESS, None, None
        _make_optional(action)
    known = {action.dest for action in bare._actions}
    return {dest: value for dest, value in vars(bare.parse_args(arguments)).items() if dest in known}


def _combine(
    table: OptionTable,
    values: Mapping[str, RawValue],
    layers: Sequence[Layer],
    origins: Mapping[str, str] | None = None,
) -> tuple[dict[str, RawValue], dict[str, str]]:
    """Return the values with those of lower layers added, and where each added value comes from."""
    combined, sources = dict(values), dict(origins or {})
    for layer in layers:
        taken = {rival for dest in combined for rival in (dest, *table.exclusive_with(dest))}
        added = {dest: value for dest, value in layer.values.items() if dest not in taken}
        combined |= added
        sources |= {dest: layer.origins[dest] for dest in added}
    return combined, sources


def _read_preset(table: OptionTable, name: RawValue | None) -> Layer:
    """Return the preset's values of the options that the program has; argparse reports unknown presets."""
    preset = PRESETS.get(str(name), {})
    values = {dest: str(preset[key]) for dest in table.actions if (key := table.key(dest)) in preset}
    return Layer(values, dict.fromkeys(values, f"preset {name}"))


def _parse_with_defaults(
    parser: argparse.ArgumentParser, arguments: Sequence[str], defaults: Mapping[str, object], all_optional: bool
) -> argparse.Namespace:
    """Parse the command line with these defaults; options that have one are no longer required."""
    final = _delegating_copy(parser)
    for action in final._actions:
        if action.dest in defaults:
            action.default = defaults[action.dest]
        if all_optional or action.dest in defaults:
            _make_optional(action)
    return final.parse_args(arguments)


def _require_paths(table: OptionTable, values: Mapping[str, RawValue]) -> None:
    """Raise InvalidInputError for an empty path, which would stand for the current folder."""
    for dest, value in values.items():
        action = table.actions[dest]
        if value == "" and (action.type is Path or dest in _PATHS_AS_TEXT):
            name = action.option_strings[0] if action.option_strings else str(action.metavar)
            raise InvalidInputError(f"{name}: expected a path, got an empty text")


def _configuration_text(
    program: str, table: OptionTable, values: Mapping[str, RawValue], options: argparse.Namespace
) -> str:
    """Return the effective options as a configuration file.

    Defaults that depend on other options are comments, so that they still depend on them when the file is read.
    """
    effective: dict[str, OptionValue] = {}
    dependent: dict[str, OptionValue] = {}
    for dest, action in table.actions.items():
        key = table.key(dest)
        value = table.file_value(dest, values[dest]) if dest in values else table.default_value(dest)
        if value is None:
            dependent[key] = dependent_default(action, options)
        effective[key] = without_password(value) if isinstance(value, str) else value
    comments = "".join(f"# {line}\n" for line in to_toml(dependent).splitlines())
    heading = "# defaults that depend on other options or on the machine\n" if comments else ""
    return f"# {program}: effective settings\n{to_toml(effective)}{heading}{comments}"


def _delegating_copy(parser: argparse.ArgumentParser) -> argparse.ArgumentParser:
    """Return a copy whose actions can be changed; help and usage are the original's."""
    duplicate = copy.deepcopy(parser)
    duplicate.format_help = parser.format_help  # type: ignore[method-assign]
    duplicate.format_usage = parser.format_usage  # type: ignore[method-assign]
    return duplicate


def _make_optional(action: argparse.Action) -> None:
    if action.option_strings:
        action.required = False
    else:
        action.nargs = {None: "?", "+": "*"}.get(action.nargs, action.nargs)  # type: ignore[arg-type]
        action.required = False
