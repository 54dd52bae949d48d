"""Entry of `gausslite`: choose the sub-command; report expected errors in one line with exit code 2."""

from __future__ import annotations

import argparse
import errno
import io
import os
import sys
from collections.abc import Callable, Collection, Sequence
from importlib import import_module
from typing import Final, cast

from gausslite.config.command_parser import CommandParser
from gausslite.config.program import parse_options
from gausslite.domain.checks import require_instance
from gausslite.domain.errors import GaussLiteError, InvalidInputError
from gausslite.plugins import Command, Group, absent_package, load, names
from gausslite.process import Terminated, print_message, raise_interrupts

_CORE: Final = {
    "map": Command("map a sequence for a task; write map.ply, report.json and preview.png", "gausslite.cli.map_command")
}


def commands() -> dict[str, Command]:
    """Return the sub-commands: those of the core, then those of the packages beside it."""
    return _CORE | {name: _plugin(name) for name in names(Group.COMMANDS) if name not in _CORE}


def _plugin(name: str) -> Command:
    """Return a command of another package; one that cannot be loaded says why when it is chosen."""
    try:
        command = load(Group.COMMANDS, name)
        require_instance(name, command, Command, "gausslite.plugins.Command(summary, module)")
    except InvalidInputError as error:
        return Command(str(error).partition(": ")[2], "")
    return cast(Command, command)


def build_parser(configured: Collection[str] | None = None) -> CommandParser:
    """Return the parser of `gausslite`. configured: commands that get their options, which imports their modules."""
    parser = CommandParser(prog="gausslite", description="Online 3D Gaussian maps that spend their detail on a task.")
    subparsers = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, command in commands().items():
        summary = command.summary
        added = subparsers.add_parser(name, help=summary, description=summary[0].upper() + summary[1:] + ".")
        if configured is None or name in configured:
            _configure(name, command)(added)
    return parser


def _configure(name: str, command: Command) -> Callable[[argparse.ArgumentParser], None]:
    """Return the function that adds the options of a command; this imports its module."""
    if not command.module:
        raise InvalidInputError(f"{name}: {command.summary}")
    module, _, function = command.module.partition(":")
    return cast(Callable[[argparse.ArgumentParser], None], getattr(import_module(module), function or "configure"))


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit code."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    if isinstance(sys.stdout, io.TextIOWrapper):
        # a character that the terminal cannot encode must not end hours of work
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        code = _dispatch(arguments)
        sys.stdout.flush()
        return code
    except GaussLiteError as error:
        return _fail(str(error))
    except ModuleNotFoundError as error:
        # packages beside the core import each other
        if (package := absent_package(error)) is None:
            raise
        return _fail(f"needs the package {package}, which is not installed")
    except BrokenPipeError:
        # the reader has read enough, as `head` does; what is still buffered goes nowhere
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    except OSError as error:
        return _fail(_describe(error))
    except Terminated as signal:
        return _interrupted("terminated", signal, 143)
    except KeyboardInterrupt as signal:
        return _interrupted("interrupted", signal, 130)


def _dispatch(arguments: list[str]) -> int:
    chosen = [word for word in arguments if not word.startswith("-")][:1]
    # import only the chosen command: the others need seconds
    options = parse_options(build_parser(chosen), arguments, warn=print_message)
    run = options.run
    raise_interrupts()
    return int(run(options))


def _fail(message: str) -> int:
    print_message(f"gausslite: {message}")
    return 2


def _interrupted(event: str, signal: KeyboardInterrupt, code: int) -> int:
    """Report an interrupt, with the text that the command has attached to it; return the exit code."""
    print_message(f"gausslite: {event}{f': {signal}' if str(signal) else ''}")
    return code


def _describe(error: OSError) -> str:
    where = f"{error.filename}: " if error.filename else ""
    if error.errno == errno.ENOSPC:
        return f"{where}the disk is full; free some space or choose another --out"
    return f"{where}{error.strerror or error}"
