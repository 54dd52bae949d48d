"""A parser of command lines that reports wrong options in one line."""

from __future__ import annotations

import argparse
from typing import NoReturn

from gausslite.process.messages import printable


class CommandParser(argparse.ArgumentParser):
    """Ends the process with code 2 and one line for wrong options; argparse prints all options before its message."""

    def error(self, message: str) -> NoReturn:
        """Print the message and the command that lists the options, and exit."""
        self.exit(2, f"{self.prog}: {printable(message)}; see `{self.prog} --help`\n")
