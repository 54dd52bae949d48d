"""`gausslite` and `python -m gausslite`: handle signals first, because imports take most of the start."""

import sys

from gausslite.process import end_quietly_while_starting


def main() -> int:
    """Run the command line and return the exit code."""
    end_quietly_while_starting("gausslite")
    from gausslite.cli.main import main as run

    return run()


if __name__ == "__main__":
    sys.exit(main())
