"""`gausslite-parser`: handle signals first, because imports take most of the start."""

import sys

from gausslite.process import end_quietly_while_starting


def main() -> int:
    """Run the program with the command line's arguments and return the exit code."""
    end_quietly_while_starting("gausslite-parser")
    from gausslite_parser.program import run

    return run()


if __name__ == "__main__":
    sys.exit(main())
