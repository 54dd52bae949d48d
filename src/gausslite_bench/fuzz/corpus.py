"""Read the corpus: valid messages of the codec and of every method, `TARGET/NAME.bin`."""

from __future__ import annotations

from pathlib import Path

from gausslite.domain.errors import InvalidInputError

CORPUS = Path(__file__).with_name("corpus")
SESSION_ID = b"f" * 32
"""Stands for the session id in the corpus; a running server gives another one of the same length."""
AGENT_ID = "fuzzer"
"""The agent that the corpus contributes as."""


def read_corpus(folder: Path) -> dict[str, list[bytes]]:
    """Return the messages of each target. Raises InvalidInputError if the folder has none."""
    targets = {
        target.name: [path.read_bytes() for path in sorted(target.glob("*.bin"))]
        for target in sorted(folder.glob("*"))
        if target.is_dir()
    }
    found = {name: messages for name, messages in targets.items() if messages}
    if not found:
        raise InvalidInputError(
            f"corpus {folder}: expected folders of messages such as subset/two-voxels.bin, got none"
        )
    return found
