"""`gausslite-agent`: may be interrupted from its first moment, so the imports come after that."""

import sys

from gausslite.interrupts import end_quietly_while_starting


def main() -> int:
    """Run the program with the arguments of the command line; returns the exit code."""
    end_quietly_while_starting("gausslite-agent")
    from gausslite_agent.program import run

    return run()


if __name__ == "__main__":
    sys.exit(main())
