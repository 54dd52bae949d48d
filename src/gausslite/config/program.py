"""The options of a program: declared by its settings classes, read from flags, environment and file.

Flags override environment variables, and those override the file. An option that excludes another one replaces it in
lower layers.
"""

from __future__ import annotations

import argparse
import os
import tomllib
from argparse import SUPPRESS, ArgumentTypeError, Namespace
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import MISSING, dataclass, replace
from enum import Enum
from functools import partial
from pathlib import Path
from typing import Any

from gausslite.config.command_parser import PARSER, CommandParser
from gausslite.config.option import OptionField, as_plain, nearest, options_of, suggestion
from gausslite.config.plain_values import Plain, describe_range, is_within, read_plain, to_toml, without_password
from gausslite.domain.errors import GaussLiteError, InvalidInputError

PREFIX = "GAUSSLITE_"
CONFIG_VARIABLE = "GAUSSLITE_CONFIG"
PROGRAM = "_program"
"""Name of the chosen program among parsed arguments."""
_CONFIG_HELP = (
    "read options from this file, and from variables such as GAUSSLITE_MAX_GAUSSIANS; variables override the file, "
    "flags override both"
)
_OWN_NAMES = frozenset({"config", "set", "print_config", PROGRAM, PARSER})


@dataclass(frozen=True, slots=True)
class _Given:
    """A value that a layer sets, and how messages name it."""

    value: Any
    origin: str
    is_toml: bool = False  # the value has a type of TOML


_Layer = Mapping[str, _Given]


@dataclass(frozen=True, slots=True)
class Program:
    """The options of a program or command, by key."""

    options: Mapping[str, OptionField]
    flags: tuple[str, ...] = ()  # keys of the options that are also flags, in the order of the help
    positional: tuple[str, ...] = ()  # those without dashes

    @classmethod
    def of(
        cls,
        *settings_classes: type,
        flags: str,
        positional: str = "",
        omit: Collection[str] = (),
        defaults: Mapping[str, Any] | None = None,
        computed: Mapping[str, Callable[[Namespace], Any]] | None = None,
    ) -> Program:
        """Return the program of these settings classes; of two options with one key, the first counts.

        omit: keys that the program does not have. defaults, computed: replace those of the declarations.
        """
        options: dict[str, OptionField] = {}
        for settings_class in settings_classes:
            options = {**options, **{k: o for k, o in options_of(settings_class).items() if k not in options}}
        options = {key: declared for key, declared in options.items() if key not in omit}
        for key, value in (defaults or {}).items():
            options[key] = replace(options[key], default=value)
        for key, function in (computed or {}).items():
            options[key] = replace(options[key], option=replace(options[key].option, computed=function))
        return cls(options, tuple(flags.split()), tuple(positional.split()))

    def add_to(self, parser: CommandParser) -> None:
        """Add the flags to a parser, with --config, --set and --print-config."""
        for key in self.positional:
            declared = self.options[key]
            parser.add_argument(declared.dest, nargs="?", default=SUPPRESS, **_argument(declared))
        for key, declared in self.options.items():
            if key not in self.positional:
                self._add_flag(parser, declared)
        add = parser.add_argument_group("configuration", self._describe_other_keys()).add_argument
        add("--config", metavar="FILE.toml", help=_CONFIG_HELP)
        add("--set", metavar="KEY=VALUE", action="append", default=[], help="set any option; may be repeated")
        add("--print-config", action="store_true", help="print all options as a file for --config, and exit")
        parser.set_defaults(**{PROGRAM: self})

    def read(
        self, parser: CommandParser, parsed: Namespace, environment: Mapping[str, str], warn: Callable[[str], None]
    ) -> Namespace:
        """Return the effective options of a parsed command line. Raises InvalidInputError.

        warn: called for every environment variable that seems to be a misspelt option. Ends the process with code 0
        after --print-config, and with code 2 if a required option is missing.
        """
        layers = [self._command_line(parsed), self._environment(environment)]
        path = parsed.config or environment.get(CONFIG_VARIABLE)
        if path:
            layers.append(self._file(Path(path)))
        given = self._combined(layers)
        others = {name: value for name, value in vars(parsed).items() if name not in _OWN_NAMES}
        options = Namespace(**others)
        for key, declared in self.options.items():
            value = _convert(declared, given[key]) if key in given else declared.default
            setattr(options, declared.dest, value)
        for message in self._misspelt_variables(environment):
            warn(f"{parser.prog}: {message}")
        if parsed.print_config:
            print(self._as_file(parser.prog, options, given), end="")
            raise SystemExit(0)
        self._require_all(parser, options)
        self._require_effect(options, given)
        return options

    def take_positional(self, parsed: Namespace, unknown: Sequence[str]) -> list[str]:
        """Set positional options from words that argparse leaves because a flag stands before them; return the rest."""
        count = next((i for i, word in enumerate(unknown) if word.startswith("-")), len(unknown))
        missing = [self.options[key].dest for key in self.positional if not hasattr(parsed, self.options[key].dest)]
        taken = min(count, len(missing))
        for dest, word in zip(missing[:taken], unknown, strict=False):
            setattr(parsed, dest, word)
        return list(unknown[taken:])

    def refuse_unknown(self, parser: CommandParser, unknown: Sequence[str]) -> None:
        """End the process with code 2 and a line about unknown flags: what they have become, or what is similar."""
        flag = next((word.partition("=")[0] for word in unknown if word.startswith("--")), None)
        key = "" if flag is None else flag.removeprefix("--")
        if key.removeprefix("no-") in self.options:
            parser.error(f"{flag}: write --set {key.removeprefix('no-')}=false")
        parser.refuse_unknown(unknown)

    def name(self, key: str) -> str:
        """Return how messages name an option: as a flag, by its placeholder if positional, or as a key of the file."""
        if key in self.positional:
            return self.options[key].option.metavar
        return f"--{key}" if key in self.flags else key

    def _add_flag(self, parser: CommandParser, declared: OptionField) -> None:
        flag = f"--{declared.key}"
        details = {"help": option_help(declared)} if declared.plain_type is bool else _argument(declared)
        if declared.key not in self.flags:
            details["help"] = SUPPRESS  # accepted but hidden: the help shows only what changes from run to run
        if declared.plain_type is bool:
            parser.add_argument(flag, action="store_true", default=SUPPRESS, **details)
        else:
            action = "append" if declared.option.repeats else "store"
            parser.add_argument(flag, action=action, default=SUPPRESS, **details)

    def _describe_other_keys(self) -> str:
        keys = [key for key in self.options if key not in (*self.flags, *self.positional)]
        if not keys:
            return ""
        return f"Further options, as --KEY, --set or in the file; --print-config describes them: {', '.join(keys)}."

    def _command_line(self, parsed: Namespace) -> _Layer:
        given: dict[str, _Given] = {}
        for text in parsed.set:
            key, equals, value = text.partition("=")
            if not equals:
                raise InvalidInputError(f"--set {text}: expected KEY=VALUE")
            self._require_known(key, f"--set {key}")
            earlier = given[key].value if key in given and self.options[key].option.repeats else []
            given[key] = _Given([*earlier, value] if self.options[key].option.repeats else value, f"--set {key}")
        for key in self.options:
            if hasattr(parsed, self.options[key].dest):
                given[key] = _Given(getattr(parsed, self.options[key].dest), self.name(key))
        return self._without_contradiction(given, "")

    def _environment(self, environment: Mapping[str, str]) -> _Layer:
        """Return the values of variables; empty ones count as unset, and a repeated option has one value per line."""
        given = {}
        for key, declared in self.options.items():
            text = environment.get(variable_name(key), "")
            if text:
                given[key] = _Given(text.splitlines() if declared.option.repeats else text, variable_name(key))
        return self._without_contradiction(given, "environment: ")

    def _file(self, path: Path) -> _Layer:
        given = {}
        for key, value in _read_toml(path).items():
            if isinstance(value, dict):
                raise InvalidInputError(
                    f"{path}: [{key}]: tables are not supported; write NAME = VALUE at the top level"
                )
            self._require_known(key, f"{path}: {key}")
            repeated = self.options[key].option.repeats and not isinstance(value, list)
            given[key] = _Given([value] if repeated else value, f"{path}: {key}", is_toml=True)
        return self._without_contradiction(given, f"{path}: ")

    def _require_known(self, key: str, origin: str) -> None:
        if key not in self.options:
            raise InvalidInputError(f"{origin}: unknown option{suggestion(key, self.options)}")

    def _rivals(self, key: str) -> Iterator[str]:
        """Yield the options that cannot be set together with this one."""
        for other, declared in self.options.items():
            if declared.option.excludes == key or self.options[key].option.excludes == other:
                yield other

    def _without_contradiction(self, given: _Layer, where: str) -> _Layer:
        for key in given:
            for rival in self._rivals(key):
                if rival in given:
                    origins = sorted(given[name].origin.removeprefix(where) for name in (key, rival))
                    raise InvalidInputError(f"{where}expected only one of {' and '.join(origins)}, got both")
        return given

    def _combined(self, layers: Sequence[_Layer]) -> dict[str, _Given]:
        """Return each option's value of the first layer that sets it or an option that excludes it."""
        combined: dict[str, _Given] = {}
        for layer in layers:
            taken = {rival for key in combined for rival in (key, *self._rivals(key))}
            combined |= {key: given for key, given in layer.items() if key not in taken}
        return combined

    def _require_all(self, parser: CommandParser, options: Namespace) -> None:
        missing = [
            self.name(key) for key, declared in self.options.items() if getattr(options, declared.dest) is MISSING
        ]
        if missing:
            parser.error(f"the following arguments are required: {', '.join(missing)}")

    def _require_effect(self, options: Namespace, given: _Layer) -> None:
        """Raise InvalidInputError for an option that differs from its default and needs another that is not given."""
        for key, source in given.items():
            declared = self.options[key]
            needed, _, values = declared.option.needs.partition("=")
            if not needed or needed not in self.options or getattr(options, declared.dest) == declared.default:
                continue
            present = getattr(options, self.options[needed].dest)
            if str(present) not in values.split("|") if values else present in (None, False, ()):
                what = values.replace("|", " or ") or _placeholder(self.options[needed])
                raise InvalidInputError(
                    f"{source.origin}: has an effect only with {self.name(needed)} {what}; give both, or omit {key}"
                )

    def _misspelt_variables(self, environment: Mapping[str, str]) -> Iterator[str]:
        """Yield a message, without the value, for each variable that is similar to that of an option."""
        names = {variable_name(key).removeprefix(PREFIX): key for key in self.options}
        for variable in sorted(environment):
            name = variable.removeprefix(PREFIX)
            if variable.startswith(PREFIX) and name not in names and (similar := nearest(name, names)) is not None:
                yield f"{variable} is not an option; did you mean {PREFIX}{similar}?"

    def _as_file(self, program: str, options: Namespace, given: _Layer) -> str:
        """Return the effective options as a configuration file with the description of each.

        Unset options are comments, and so are defaults that depend on other options or on the machine: they still
        depend on them when the file is read.
        """
        lines = [f"# {program}: effective settings"]
        for key, declared in self.options.items():
            lines.append(f"\n# {option_help(declared)}")
            value = _plain_value(declared, given.get(key))
            if value is not None:
                lines.append(to_toml({key: value}).rstrip("\n"))
                continue
            computed = None if declared.option.computed is None else declared.option.computed(options)
            # without the empty key and " = "
            shown = _placeholder(declared, quoted=True) if computed is None else to_toml({"": as_plain(computed)})[3:]
            lines.append(f"# {key} = {shown}".rstrip())
        return "\n".join(lines) + "\n"


def parse_options(
    parser: CommandParser,
    arguments: Sequence[str] | None = None,
    environment: Mapping[str, str] | None = None,
    *,
    warn: Callable[[str], None],
) -> Namespace:
    """Return the options of a command line; those of the chosen command's `Program` also from environment and file.

    Ends the process with code 2 for wrong flags. Raises InvalidInputError for wrong values.
    """
    environment = os.environ if environment is None else environment
    parsed, unknown = parser.parse_known_args(arguments)
    program: Program | None = getattr(parsed, PROGRAM, None)
    chosen: CommandParser = getattr(parsed, PARSER)
    if program is not None:
        unknown = program.take_positional(parsed, unknown)
    if unknown and program is not None:
        program.refuse_unknown(chosen, unknown)
    if unknown:
        chosen.refuse_unknown(unknown)
    return parsed if program is None else program.read(chosen, parsed, environment, warn)


def add_flags(parser: argparse._ActionsContainer, settings_class: type, *keys: str) -> None:
    """Add these options of a settings class, or all, as flags of a command that reads no file and no variables."""
    for key, declared in options_of(settings_class).items():
        if not keys or key in keys:
            convert, needed = partial(_convert_text, declared), declared.default is MISSING
            default = None if needed else declared.default
            parser.add_argument(f"--{key}", type=convert, default=default, required=needed, **_argument(declared))


def _convert_text(declared: OptionField, text: str) -> Any:
    return _convert(declared, _Given(text, f"--{declared.key}"))


def variable_name(key: str) -> str:
    """Return the environment variable of an option: GAUSSLITE_MAX_GAUSSIANS for max-gaussians."""
    return f"{PREFIX}{key.replace('-', '_').upper()}"


def option_help(declared: OptionField, *, with_choices: bool = True) -> str:
    """Return the help of an option with its choices, its range, what it needs, and its default."""
    option = declared.option
    details = [", ".join(choices_of(declared))] if with_choices else []
    details.append(describe_range(option.low, option.high, option.unit))
    if option.needs:
        details.append(f"needs {option.needs.replace('=', ' ').replace('|', ' or ')}")
    if option.excludes:
        details.append(f"instead of {option.excludes}")
    if "default: " not in option.help and (default := default_text(declared)):
        details.append(f"default: {default}")
    text = "; ".join(filter(None, details))
    if text and option.help.endswith(")"):
        return f"{option.help[:-1]}; {text})"
    return f"{option.help} ({text})" if text else option.help


def choices_of(declared: OptionField) -> tuple[str, ...]:
    """Return the texts that an option accepts; empty if it accepts others."""
    kind = declared.plain_type
    if isinstance(kind, type) and issubclass(kind, Enum):
        return tuple(str(member.value) for member in kind)
    return declared.option.choices


def default_text(declared: OptionField) -> str:
    """Return an option's default for people; empty for none, false and an empty list."""
    if declared.default in (None, False, MISSING, (), frozenset(), ""):
        return ""
    plain = as_plain(declared.to_plain(declared.default))
    if isinstance(plain, list):
        return ",".join(plain)
    return f"{plain:g}" if isinstance(plain, float) else str(plain)


def _convert(declared: OptionField, given: _Given) -> Any:
    """Return the field's value. Raises InvalidInputError that names where the value comes from."""
    option = declared.option
    try:
        value = read_plain(declared.plain_type, given.value, is_toml=given.is_toml)
        if option.choices and value not in option.choices:
            raise InvalidInputError(f"expected one of {', '.join(option.choices)}, got {value!r}")
        if isinstance(value, int | float) and not is_within(value, option.low, option.high):
            expected = describe_range(option.low, option.high, option.unit)
            raise InvalidInputError(f"expected {expected}, got {given.value}")
        return value if option.convert is None else option.convert(value)
    except (GaussLiteError, ArgumentTypeError) as error:
        raise InvalidInputError(f"{given.origin}: {str(error).removeprefix(f'{declared.key}: ')}") from None


def _plain_value(declared: OptionField, given: _Given | None) -> Plain:
    """Return an option's value, or else its default, as a file has it; None for none."""
    if given is not None:
        plain = as_plain(read_plain(declared.plain_type, given.value, is_toml=given.is_toml))
    elif declared.default is MISSING or declared.default == ():
        return None
    else:
        plain = as_plain(declared.to_plain(declared.default))
    return without_password(plain) if isinstance(plain, str) else plain


def _argument(declared: OptionField) -> dict[str, Any]:
    """Return the arguments of argparse for an option with a value."""
    placeholder = _placeholder(declared)
    shown = "|".join(choices_of(declared))
    help_text = option_help(declared, with_choices=placeholder != shown)
    return {"metavar": placeholder, "help": help_text.replace("%", "%%")}


def _placeholder(declared: OptionField, quoted: bool = False) -> str:
    """Return the name of an option's value: its metavar, its choices, or one of its type."""
    choices = choices_of(declared)
    short = "|".join(choices) if len(choices) <= 4 else "NAME"
    kinds = {int: "N", float: "X", bool: "true", Path: "PATH"}
    text = declared.option.metavar or (short if choices else kinds.get(declared.plain_type, "TEXT"))
    return f'"{text}"' if quoted and declared.plain_type not in (int, float, bool) else text


def _read_toml(path: Path) -> dict[str, Any]:
    try:
        # some editors begin a file with a byte order mark, which TOML does not allow
        return tomllib.loads(path.read_bytes().decode("utf-8-sig"))
    except OSError as error:
        raise InvalidInputError(f"--config {path}: expected a TOML file: {error.strerror or error}") from None
    except UnicodeDecodeError as error:
        raise InvalidInputError(
            f"--config {path}: expected UTF-8 text, got another encoding (byte {error.start}); save the file as UTF-8"
        ) from None
    except ValueError as error:
        raise InvalidInputError(f"--config {path}: expected TOML: {error}") from None
