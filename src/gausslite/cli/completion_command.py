"""`gausslite completion`: print the script with which a shell completes a program's commands, options and files."""

from __future__ import annotations

import argparse
import importlib
from collections.abc import Iterator
from pathlib import Path

from gausslite.cli.main import build_parser
from gausslite.config.command_parser import CommandParser
from gausslite.config.values import read_path
from gausslite.process import import_extra

_SHELLS = ("bash", "zsh", "fish")
_GAUSSLITE = "gausslite"
_FILE_METAVARS = ("DIR", "FILE", "FILE.npz", "FILE.onnx", "FILE.toml")
_SERVICES = {
    "gausslite-agent": ("gausslite_agent.settings", "build_parser"),
    "gausslite-fusion-server": ("gausslite_fusion_server.settings", "build_parser_with_commands"),
    "gausslite-parser": ("gausslite_parser.program", "build_parser"),
}
"""Modules and functions of the service programs; by name, because the services are siblings of the command line."""


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the shell and the program."""
    parser.add_argument("shell", choices=_SHELLS, help="the shell that reads the script")
    parser.add_argument(
        "program",
        nargs="?",
        choices=(_GAUSSLITE, *_SERVICES),
        default=_GAUSSLITE,
        help="the program whose words are completed (default: %(default)s)",
    )
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Print the script. Returns the exit code. Raises InvalidInputError if shtab is not installed."""
    shtab = import_extra("shtab", "completion", "completion")
    parser = _parser_of(options.program)
    for action in _actions(parser):
        if action.type in (Path, read_path) or action.metavar in _FILE_METAVARS:
            # shtab reads this attribute of an action
            vars(action)["complete"] = shtab.DIRECTORY if action.metavar == "DIR" else shtab.FILE
    print(shtab.complete(parser, options.shell))
    return 0


def _parser_of(program: str) -> CommandParser:
    if program == _GAUSSLITE:
        return build_parser()
    module, function = _SERVICES[program]
    parser: CommandParser = getattr(importlib.import_module(module), function)()
    return parser


def _actions(parser: CommandParser) -> Iterator[argparse.Action]:
    """Yield the options and arguments of the parser and of all its sub-commands."""
    yield from parser._actions
    for command in parser.commands.values():
        yield from _actions(command)
