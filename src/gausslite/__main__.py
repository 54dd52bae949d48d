"""`gausslite`, and `python -m gausslite`: may be interrupted from its first moment, so the imports come after that."""

import sys

from gausslite.interrupts import end_quietly_while_starting


def main() -> int:
    """Run the command line; returns the exit code."""
    end_quietly_while_starting("gausslite")
    from gausslite.cli.main import main as run

    return run()


if __name__ == "__main__":
    sys.exit(main())
