"""Read the small text files of a sequence: rows of numbers. Every error names the file and line."""

from __future__ import annotations

from pathlib import Path

from gausslite.domain.errors import DatasetError


def read_text(path: Path) -> str:
    """Return the whole file without a byte-order mark. Raises DatasetError if it is missing or not text."""
    try:
        return path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise DatasetError(f"{path}: expected a text file, got none") from None
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError(f"{path}: expected a readable text file, got {type(error).__name__}") from None


def read_rows(path: Path) -> list[tuple[str, list[str]]]:
    """Return the location ("FILE line 3") and the fields of each row, without blank rows and comments (#)."""
    rows = []
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        text = line.strip()
        if text and not text.startswith("#"):
            rows.append((f"{path} line {number}", text.split()))
    return rows


def parse_numbers(location: str, fields: list[str], count: int, meaning: str) -> list[float]:
    """Return exactly `count` numbers, which may be NaN or infinite. Raises DatasetError with the location."""
    if len(fields) != count:
        raise DatasetError(f"{location}: expected {count} numbers ({meaning}), got {len(fields)}")
    try:
        return [float(field) for field in fields]
    except ValueError as error:
        raise DatasetError(f"{location}: expected {count} numbers ({meaning}); {error}") from None
