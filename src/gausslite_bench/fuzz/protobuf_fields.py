"""Change fields of an encoded protobuf message without its schema."""

from __future__ import annotations

import math
import random
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5
_FIXED_BYTES = {_FIXED64: 8, _FIXED32: 4}
_EXTREME_INTEGERS = (0, 1, 127, 1 << 31, (1 << 32) - 1, (1 << 63) - 1, 1 << 63, (1 << 64) - 1)
_EXTREME_NUMBERS = (0.0, math.inf, math.nan, -1.0, 3e38)
_EXTREME_TEXTS = (b"", b"\x00", b"\xff\xfe", "\u202e\U0001f916".encode(), b"\x1b[2J\n", b"a" * 10_000)
_MAX_DEPTH = 4


@dataclass(frozen=True, slots=True)
class Field:
    """One field of a message: its number, its wire type, and its bytes without key and length."""

    number: int
    wire_type: int
    value: bytes


def parse_fields(data: bytes) -> list[Field] | None:
    """Return the fields of a message; None if the bytes are not one."""
    try:
        return list(_fields(data))
    except (IndexError, ValueError):
        return None


def encode_fields(fields: Sequence[Field]) -> bytes:
    """Return the message of these fields."""
    parts = []
    for field in fields:
        parts.append(encode_varint(field.number << 3 | field.wire_type))
        if field.wire_type == _BYTES:
            parts.append(encode_varint(len(field.value)))
        parts.append(field.value)
    return b"".join(parts)


def encode_varint(number: int) -> bytes:
    """Return an unsigned integer of up to 64 bits in seven bits a byte."""
    out = bytearray()
    while number > 0x7F:
        out.append(number & 0x7F | 0x80)
        number >>= 7
    return bytes([*out, number])


def change_field(data: bytes, rng: random.Random, depth: int = 0) -> bytes:
    """Return the message with one field changed, removed, repeated, renumbered or swapped, at any depth."""
    fields = parse_fields(data)
    if not fields:
        return data + encode_fields([Field(rng.randint(1, 16), _VARINT, encode_varint(rng.choice(_EXTREME_INTEGERS)))])
    index = rng.randrange(len(fields))
    chosen = fields[index]
    match rng.randrange(8):
        case 0:
            del fields[index]
        case 1:
            fields.insert(index, chosen)
        case 2:
            fields[index] = replace(chosen, number=rng.randint(1, 20))
        case 3:
            other = rng.randrange(len(fields))
            fields[index], fields[other] = fields[other], fields[index]
        case _:
            fields[index] = replace(chosen, value=_changed_value(chosen, rng, depth))
    return encode_fields(fields)


def _changed_value(field: Field, rng: random.Random, depth: int) -> bytes:
    if field.wire_type == _VARINT:
        return encode_varint(rng.choice(_EXTREME_INTEGERS))
    if field.wire_type in _FIXED_BYTES:
        return struct.pack("<d" if field.wire_type == _FIXED64 else "<f", rng.choice(_EXTREME_NUMBERS))
    if depth < _MAX_DEPTH and field.value and parse_fields(field.value) and rng.random() < 0.8:
        return change_field(field.value, rng, depth + 1)
    return rng.choice(_EXTREME_TEXTS)


def _fields(data: bytes) -> Iterator[Field]:
    start = 0
    while start < len(data):
        key, start = _varint(data, start)
        number, wire_type = key >> 3, key & 7
        length, start = _varint(data, start) if wire_type == _BYTES else (_FIXED_BYTES.get(wire_type, 0), start)
        end = _varint(data, start)[1] if wire_type == _VARINT else start + length
        if number == 0 or wire_type not in (_VARINT, _BYTES, *_FIXED_BYTES) or end > len(data):
            raise ValueError("field: expected a number above 0, a wire type and a value inside the message")
        yield Field(number, wire_type, data[start:end])
        start = end


def _varint(data: bytes, start: int) -> tuple[int, int]:
    """Return a number and where it ends. Raises IndexError, ValueError."""
    number = 0
    for shift in range(0, 70, 7):
        byte = data[start]
        start += 1
        number |= (byte & 0x7F) << shift
        if byte < 0x80:
            return number, start
    raise ValueError("varint: expected at most ten bytes")
