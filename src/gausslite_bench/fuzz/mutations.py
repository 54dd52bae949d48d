"""Mutate messages: bits, bytes, lengths, splices, numbers at their limits, and fields of protobuf messages."""

from __future__ import annotations

import random
import struct
from collections.abc import Sequence
from typing import TypeVar

from gausslite_bench.fuzz.checksummed_messages import change_body, with_checksum
from gausslite_bench.fuzz.protobuf_fields import change_field, encode_fields, parse_fields

_NUMBERS = (
    *(struct.pack(code, value) for code, value in (("<B", 0), ("<B", 255), ("<H", 65535), ("<h", -32768))),
    *(struct.pack("<I", value) for value in (0, 1, 200_001, 1 << 31, (1 << 32) - 1)),
    *(struct.pack("<Q", value) for value in (0, 1 << 32, (1 << 63) - 1, 1 << 63, (1 << 64) - 1)),
    *(struct.pack("<d", value) for value in (0.0, -1.0, 1e-300, 1e300, float("inf"), float("nan"))),
    *(struct.pack("<f", value) for value in (-1.0, 3e38, float("inf"), float("nan"))),
)
Value = TypeVar("Value")
_MAX_EDITS = 4
_MAX_BYTES = 1 << 21
_SEALED = (b"GLSB", b"GLFS")


class Mutator:
    """Mutates messages by one generator of random numbers, so that a seed gives the same messages."""

    def __init__(self, seed: int) -> None:
        self._rng = random.Random(seed)  # noqa: S311 - reproducible messages

    def choose(self, values: Sequence[Value]) -> Value:
        """Return one of these messages or names."""
        return self._rng.choice(values)

    def chance(self, share: float) -> bool:
        """Return True in this share of the calls."""
        return self._rng.random() < share

    def mutate_bytes(self, data: bytes, others: Sequence[bytes] = ()) -> bytes:
        """Return the bytes after one to four edits; others: messages whose parts may be spliced in."""
        for _ in range(self._rng.randint(1, _MAX_EDITS)):
            data = self._edit(data, others)
        return data[:_MAX_BYTES]

    def mutate_codec(self, data: bytes, others: Sequence[bytes] = ()) -> bytes:
        """Mutate a message of the codec; most get a valid checksum, and in half the unpacked body changes."""
        if not self.chance(0.5) or not data.startswith(_SEALED):
            data = self.mutate_bytes(data, others)
            return with_checksum(data) if len(data) > 4 and self.chance(0.8) else data
        return change_body(data, lambda body: self.mutate_bytes(body))

    def mutate_protobuf(self, data: bytes, others: Sequence[bytes] = ()) -> bytes:
        """Mutate a protobuf message: its fields, a codec message inside it, or its bytes."""
        if self.chance(0.2):
            return self.mutate_bytes(data, others)
        fields = parse_fields(data) or []
        inner = [index for index, field in enumerate(fields) if field.value.startswith(_SEALED)]
        if inner and self.chance(0.7):
            field = fields[inner[0]]
            changed = type(field)(field.number, field.wire_type, self.mutate_codec(field.value))
            return encode_fields([*fields[: inner[0]], changed, *fields[inner[0] + 1 :]])
        for _ in range(self._rng.randint(1, _MAX_EDITS)):
            data = change_field(data, self._rng)
        return data[:_MAX_BYTES]

    def _edit(self, data: bytes, others: Sequence[bytes]) -> bytes:
        rng, size = self._rng, len(data)
        place = rng.randrange(size + 1)
        match rng.randrange(7):
            case 0 if place < size:
                return data[:place] + bytes([data[place] ^ 1 << rng.randrange(8)]) + data[place + 1 :]
            case 1 if place < size:
                return data[:place] + rng.randbytes(1) + data[place + 1 :]
            case 2:
                return data[:place]
            case 3:
                return data[:place] + rng.randbytes(rng.randint(1, 16)) + data[place:]
            case 4:
                number = rng.choice(_NUMBERS)
                return data[:place] + number + data[place + len(number) :]
            case 5 if others:
                other = rng.choice(others)
                return data[:place] + other[rng.randrange(len(other) + 1) :]
            case _:
                end = min(size, place + rng.randint(1, 64))
                return data[:end] + data[place:end] + data[end:]
