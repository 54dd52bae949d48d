"""Declare boolean options, and the defaults that depend on other options."""

from __future__ import annotations

import argparse
from collections.abc import Callable

from gausslite.config.toml_text import OptionValue

DependentDefault = Callable[[argparse.Namespace], OptionValue]
"""Returns the value that a program uses for an unset option, from its other options."""


def add_switch(parser: argparse._ActionsContainer, flag: str, help_text: str, default: bool = False) -> None:
    """Add a boolean option, off unless `default` is True: --flag turns it on, --no-flag turns it off."""
    action = parser.add_argument(flag, action=argparse.BooleanOptionalAction, help=help_text)
    # set afterwards, because the action would append its default to the help
    action.default = default


def set_dependent_default(action: argparse.Action, default: DependentDefault) -> None:
    """State which value a program uses if this option is not set, for --print-config."""
    vars(action)["dependent_default"] = default


def dependent_default(action: argparse.Action, options: argparse.Namespace) -> OptionValue:
    """Return the value that the program uses if this option is not set; None if that is not stated."""
    default: DependentDefault | None = vars(action).get("dependent_default")
    return None if default is None else default(options)
