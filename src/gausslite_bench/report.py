"""Print what a benchmark has measured: as JSON, or as lines for people."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from gausslite.mission.results import as_text


@dataclass(frozen=True, slots=True)
class Report:
    """Figures by name, nested as the benchmark found them. is_good: False makes the command end with code 1."""

    values: Mapping[str, Any]
    is_good: bool = True

    def text(self, as_json: bool) -> str:
        """Return the figures as one JSON object, or one line for each group of figures."""
        return as_text(dict(self.values)) if as_json else "\n".join(_lines(self.values, ""))


def _lines(values: Mapping[str, Any], indent: str) -> Iterator[str]:
    for name, value in values.items():
        parts = (
            value if isinstance(value, list | tuple) and any(isinstance(part, Mapping) for part in value) else [value]
        )
        for part in parts:
            if not isinstance(part, Mapping):
                yield f"{indent}{name}: {_plain(part)}"
            elif any(isinstance(inner, Mapping | list | tuple) for inner in part.values()):
                yield f"{indent}{name}:"
                yield from _lines(part, f"{indent}  ")
            else:
                yield f"{indent}{name}: {', '.join(f'{key} {_plain(inner)}' for key, inner in part.items())}"


def _plain(value: object) -> str:
    if isinstance(value, list | tuple):
        return ", ".join(map(_plain, value)) or "none"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
