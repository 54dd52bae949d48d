"""Converters for argparse: each returns the parsed value or raises ArgumentTypeError with the expected form."""

from __future__ import annotations

import argparse

from gausslite.config.plain_values import split_names
from gausslite.config.values import read_numbers


def read_image_sizes(text: str) -> tuple[tuple[int, int], ...]:
    """Parse "WxH,WxH"."""
    sizes = tuple(tuple(_positive(side) for side in part.lower().split("x")) for part in split_names(text))
    pairs = tuple((size[0], size[1]) for size in sizes if len(size) == 2)
    if not sizes or len(pairs) != len(sizes):
        raise argparse.ArgumentTypeError(f"expected sizes such as 320x240,640x480, got {text!r}")
    return pairs


def read_image_size(text: str) -> tuple[int, int]:
    """Parse "WxH" with sides of 16 to 4096 pixels."""
    sides = text.lower().split("x")
    if len(sides) != 2 or not all(side.isascii() and side.isdigit() and 16 <= int(side[:6]) <= 4096 for side in sides):
        raise argparse.ArgumentTypeError(f"expected WIDTHxHEIGHT with sides of 16 to 4096, got {text!r}")
    return int(sides[0]), int(sides[1])


def read_counts(text: str) -> tuple[int, ...]:
    """Parse "N,N" with N > 0."""
    counts = tuple(_positive(part) for part in split_names(text))
    if not counts:
        raise argparse.ArgumentTypeError(f"expected whole numbers such as 20000,100000, got {text!r}")
    return counts


def read_seeds(text: str) -> tuple[int, ...]:
    """Parse "N,N" with N >= 0."""
    parts = split_names(text)
    if not parts or not all(part.isascii() and part.isdigit() and len(part) < 10 for part in parts):
        raise argparse.ArgumentTypeError(f"expected whole numbers such as 0,1,2, got {text!r}")
    return tuple(int(part) for part in parts)


def read_percentages(text: str) -> tuple[float, ...]:
    """Parse "5,20"; "0" means none."""
    if text.strip() == "0":
        return ()
    shares = read_numbers(text, text.count(",") + 1)
    if not all(0 < share <= 100 for share in shares):
        raise argparse.ArgumentTypeError(f"expected percentages above 0 and up to 100, or 0 alone, got {text!r}")
    return tuple(shares)


def _positive(text: str) -> int:
    if not (text.isascii() and text.isdigit() and 0 < len(text) < 10 and int(text) > 0):
        raise argparse.ArgumentTypeError(f"expected whole numbers above 0, got {text!r}")
    return int(text)
