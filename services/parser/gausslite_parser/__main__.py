"""`gausslite-parser`: handle signals first, because imports take most of the start."""

import sys

from gausslite.process import run_program


def main() -> int:
    """Run the program with the command line's arguments and return the exit code."""
    return run_program("gausslite-parser", "gausslite_parser.program")


if __name__ == "__main__":
    sys.exit(main())
