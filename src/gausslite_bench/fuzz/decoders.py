"""Read the corpus of valid messages, `TARGET/NAME.bin`, and decode mutated ones of the codec in this process."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from gausslite.codec.encoded_voxels import EncodedVoxels, from_records
from gausslite.codec.json import decode_object_report
from gausslite.codec.ply import gaussians_from_ply, world_frame_from_ply
from gausslite.codec.subset_codec import decode_subset
from gausslite.domain.errors import GaussLiteError, InvalidInputError
from gausslite.wire.convert import decode_frame
from gausslite_bench.fuzz.mutations import Mutator

CORPUS = Path(__file__).with_name("corpus")
SESSION_ID = b"f" * 32
"""Stands for the session id in the corpus; a running server gives another one of the same length."""
AGENT_ID = "fuzzer"
"""The agent that the corpus contributes as."""
HANG_S = 1.0


DECODERS: Mapping[str, Callable[[bytes], object]] = {
    "subset": decode_subset,
    "keyframe": decode_frame,
    "object-report": decode_object_report,
    "records": from_records,
    "stored-row": lambda data: EncodedVoxels.from_row(data).batch(),
    "ply": lambda data: (world_frame_from_ply(data), gaussians_from_ply(data)),
}
_SHARES = {"subset": 0.6, "keyframe": 0.1, "object-report": 0.1, "records": 0.05, "stored-row": 0.05, "ply": 0.1}


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


@dataclass(slots=True)
class Outcomes:
    """Messages by their result: OK, the name of an error or of a status code; and the faults with their messages."""

    results: Counter[str] = field(default_factory=Counter)
    crashes: list[tuple[str, bytes]] = field(default_factory=list)
    hangs: list[tuple[str, bytes]] = field(default_factory=list)
    slowest_s: float = 0.0

    @property
    def messages(self) -> int:
        """The number of messages."""
        return self.results.total()


def mutated_messages(corpus: Mapping[str, list[bytes]], mutator: Mutator, count: int) -> Iterator[tuple[str, bytes]]:
    """Yield the target and the bytes of `count` mutated messages of the codec."""
    for name, share in _SHARES.items():
        mutate = mutator.mutate_protobuf if name == "keyframe" else mutator.mutate_codec
        for _ in range(round(count * share)):
            yield name, mutate(mutator.choose(corpus[name]), corpus[name])


def decode_one(name: str, data: bytes, outcomes: Outcomes) -> None:
    """Decode one message; any error that is no GaussLiteError is a crash, more than HANG_S of the processor a hang."""
    begin_s = time.process_time()
    try:
        DECODERS[name](data)
        outcomes.results["OK"] += 1
    except GaussLiteError as error:
        outcomes.results[type(error).__name__] += 1
    except Exception as error:
        outcomes.results[type(error).__name__] += 1
        outcomes.crashes.append((f"{name}: {type(error).__name__}: {error}", data))
    took_s = time.process_time() - begin_s
    outcomes.slowest_s = max(outcomes.slowest_s, took_s)
    if took_s > HANG_S:
        outcomes.hangs.append((f"{name}: {took_s:.1f} s", data))
