"""`gausslite` and `python -m gausslite`: handle signals first, because imports take most of the start."""

import sys

from gausslite.process import run_program


def main() -> int:
    """Run the command line and return the exit code."""
    return run_program("gausslite", "gausslite.cli.main", "main")


if __name__ == "__main__":
    sys.exit(main())
