"""Entry of `gausslite`: choose the sub-command; report expected errors in one line with exit code 2."""

from __future__ import annotations

import errno
import io
import os
import sys
from collections.abc import Sequence

from gausslite.cli.commands import build_parser
from gausslite.config.program import parse_options
from gausslite.domain.errors import GaussLiteError
from gausslite.process.interrupts import Terminated, raise_interrupts
from gausslite.process.messages import print_message


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit code."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    if isinstance(sys.stdout, io.TextIOWrapper):
        # a character that the terminal cannot encode must not end hours of work
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        return _dispatch(arguments)
    except GaussLiteError as error:
        return _fail(str(error))
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
    if error.errno == errno.EPIPE:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return f"{where}{error.strerror or error}"
