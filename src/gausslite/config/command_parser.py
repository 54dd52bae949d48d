"""A parser of command lines that reports wrong options in one line."""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable, Sequence
from typing import Any, NoReturn

from gausslite.config.option import nearest, suggestion
from gausslite.config.plain_values import describe_range, is_within, read_plain, without_password
from gausslite.domain.errors import InvalidInputError
from gausslite.process import installed_version, printable

PARSER = "_parser"
"""Name of the chosen command's parser among parsed arguments."""


class _PrintVersion(argparse.Action):
    """Print the version of the installed distribution, which is looked up only on request."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        print(parser.prog, installed_version())
        parser.exit()


class CommandParser(argparse.ArgumentParser):
    """Ends the process with code 2 and one line for wrong options; argparse prints all options before its message.

    Options cannot be abbreviated: an abbreviation would change its meaning with the next option.
    """

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **{**options, "allow_abbrev": False})
        # also of a point such as -1.5,0,2: argparse takes only single numbers for values
        self._negative_number_matcher = re.compile(r"-\.?\d[\d.,eE+-]*$")
        self.add_argument("--version", action=_PrintVersion, nargs=0, help="print the version and exit")
        # that of the chosen sub-command, whose help has the options
        self.set_defaults(**{PARSER: self})

    def error(self, message: str) -> NoReturn:
        """Print the message and the command that lists the options, and exit."""
        self.exit(2, f"{self.prog}: {printable(without_password(message))}; see `{self.prog} --help`\n")

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        """Name the nearest command or choice, which argparse does from Python 3.14 on."""
        if action.choices is not None and value not in action.choices:
            similar = nearest(str(value), map(str, action.choices))
            if similar is not None:
                raise argparse.ArgumentError(action, f"invalid choice: {value!r}; did you mean {similar}?")
        super()._check_value(action, value)

    @property
    def flags(self) -> list[str]:
        """The long options of this parser."""
        return [flag for action in self._actions for flag in action.option_strings if flag.startswith("--")]

    @property
    def commands(self) -> dict[str, CommandParser]:
        """The parsers of the sub-commands by name; empty without sub-commands."""
        for action in self._actions:
            if isinstance(action, argparse._SubParsersAction):
                return dict(action.choices)
        return {}

    def refuse_unknown(self, unknown: Sequence[str]) -> NoReturn:
        """End the process with a line about the arguments that argparse does not know."""
        flag = next((word.partition("=")[0] for word in unknown if word.startswith("--")), None)
        similar = "; arguments stand before the options" if flag is None else suggestion(flag, self.flags)
        self.error(f"unrecognized arguments: {' '.join(unknown)}{similar}")


def bounded(kind: type[int] | type[float], low: float, high: float | None = None) -> Callable[[str], int | float]:
    """Return a converter of argparse for a number within these bounds, both included."""

    def read(text: str) -> int | float:
        try:
            value: int | float = read_plain(kind, text)
        except InvalidInputError as error:
            raise argparse.ArgumentTypeError(str(error)) from None
        if not is_within(value, low, high):
            raise argparse.ArgumentTypeError(f"expected {describe_range(low, high)}, got {text}")
        return value

    return read
