"""The marked blocks of a page: `<!-- test -->` before a fenced block, `<!-- test: service -->` before a service.

`python tests/support/guide_blocks.py PAGE` runs a page's blocks in the current folder. It needs no test packages.
"""

import os
import re
import socket
import subprocess
import sys
import sysconfig
from dataclasses import dataclass
from pathlib import Path

TINY = {
    "GAUSSLITE_SIZE": "64x48",
    "GAUSSLITE_FRAMES": "0:90:10",
    "GAUSSLITE_ITERATIONS": "2",
    "GAUSSLITE_MAX_GAUSSIANS": "2000",
    "GAUSSLITE_THREADS": "1",
}


@dataclass(frozen=True)
class Block:
    """A fenced block of a page: its language, its text, and whether it is a service."""

    language: str
    text: str
    is_service: bool

    def command(self) -> list[str]:
        return (
            [sys.executable, "-c", self.text]
            if self.language == "python"
            else ["bash", "-euo", "pipefail", "-c", self.text]
        )


def blocks(page: Path) -> list[Block]:
    """Return the marked blocks of a page, with free ports."""
    found = re.findall(
        r"^<!-- test(: service)? -->\n```(\w+)\n(.*?)^```", page.read_text(encoding="utf-8"), re.M | re.S
    )
    text = "".join(body for _, _, body in found)
    ports = {port: free_port() for port in sorted(set(re.findall(r"(?<=:)500\d\d\b", text)))}
    replaced = re.compile("|".join(rf"(?<=:){port}\b" for port in ports) or r"(?!)")
    return [
        Block(language, replaced.sub(lambda m: ports[m[0]], body), bool(service)) for service, language, body in found
    ]


def free_port() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return str(probe.getsockname()[1])


def tiny_environment() -> dict[str, str]:
    """Return the environment of a reader whose commands map tiny images and few frames."""
    return {**os.environ, **TINY, "PATH": f"{sysconfig.get_path('scripts')}:{os.environ['PATH']}"}


def main() -> None:
    """Run the blocks of the page that the command line names; end at the first failure."""
    marked = blocks(Path(sys.argv[1]))
    assert marked, f"{sys.argv[1]}: expected marked blocks, got none"
    for block in marked:
        assert not block.is_service, f"expected no service, got {block.text}"
        print(block.text, flush=True)
        subprocess.run(block.command(), env=tiny_environment(), check=True)


if __name__ == "__main__":
    main()
