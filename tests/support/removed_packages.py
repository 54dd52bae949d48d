"""Run commands and services in this process, which sees no hidden package (`without_extras`); print JSON.

Arguments: the working folder, the commands that must work, and those that must be refused, both as JSON.
"""

import json
import os
import signal
import socket
import sys
import threading
from contextlib import suppress

from guide_blocks import free_port
from minimal_install import run


def served(program: str, *arguments: str) -> dict[str, object]:
    """Start a service, and stop it by a signal as soon as it listens. Returns its result."""
    port, ended = free_port(), threading.Event()

    def stop_when_listening() -> None:
        while not ended.wait(0.05):
            with suppress(OSError), socket.create_connection(("127.0.0.1", int(port)), timeout=1.0):
                os.kill(os.getpid(), signal.SIGTERM)
                return

    stopper = threading.Thread(target=stop_when_listening)
    stopper.start()
    result = run(program, ("--listen", f"127.0.0.1:{port}", *arguments))
    ended.set()
    stopper.join()
    return result


def main() -> None:
    """Print the results of all runs."""
    os.chdir(sys.argv[1])
    working, refused = (json.loads(text) for text in sys.argv[2:])
    works = [
        run(program, arguments) if program == "gausslite" else served(program, *arguments)
        for program, *arguments in working
    ]
    print(json.dumps({"working": works, "refused": [run(program, arguments) for program, *arguments in refused]}))


if __name__ == "__main__":
    main()
