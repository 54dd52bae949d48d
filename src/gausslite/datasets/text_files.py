"""Read the small text files of a sequence: numbers in rows, with the file and line in every complaint."""

from __future__ import annotations

from pathlib import Path

from gausslite.errors import DatasetError


def read_text(path: Path) -> str:
    """The whole file. Raises DatasetError when it is missing or not text."""
    try:
        return path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise DatasetError(f"{path}: expected a text file, there is none") from None
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError(f"{path}: expected a readable text file, got {type(error).__name__}") from None


def read_rows(path: Path) -> list[tuple[str, list[str]]]:
    """Each row's place ("FILE line 3") and its fields; blank rows and rows that start with # are left out."""
    rows = []
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        text = line.strip()
        if text and not text.startswith("#"):
            rows.append((f"{path} line {number}", text.split()))
    return rows


def parse_numbers(place: str, fields: list[str], count: int, meaning: str) -> list[float]:
    """Exactly `count` numbers (NaN and infinity included). Raises DatasetError naming the place."""
    if len(fields) != count:
        raise DatasetError(f"{place}: expected {count} numbers ({meaning}), got {len(fields)}")
    try:
        return [float(field) for field in fields]
    except ValueError as error:
        raise DatasetError(f"{place}: expected {count} numbers ({meaning}); {error}") from None
