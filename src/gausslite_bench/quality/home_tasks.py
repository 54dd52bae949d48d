"""The 24 tasks in simulated homes with the objects in their regions, of home_tasks.toml."""

from __future__ import annotations

import functools
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from gausslite.domain.errors import InvalidInputError


@dataclass(frozen=True, slots=True)
class HomeTask:
    """A task in a home. kind: manipulation, search or navigation. objects: the ground-truth objects in its region."""

    home: int
    kind: str
    task: str
    objects: tuple[str, ...]

    @property
    def name(self) -> str:
        """Such as home-3-search."""
        return f"home-{self.home}-{self.kind}"


@functools.cache
def home_tasks() -> tuple[HomeTask, ...]:
    """Return the tasks, home by home."""
    homes = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))
    return tuple(
        HomeTask(int(home.removeprefix("home-")), kind, task, tuple(objects))
        for home, kinds in homes.items()
        for kind, (task, *objects) in kinds.items()
    )


def choose_home_tasks(names: Sequence[str]) -> tuple[HomeTask, ...]:
    """Return the tasks whose name equals or starts with one of these ("home-3" selects three); all without names.

    Raises InvalidInputError.
    """
    chosen = tuple(
        task for task in home_tasks() if not names or any(f"{task.name}-".startswith(f"{name}-") for name in names)
    )
    unknown = [name for name in names if not any(f"{task.name}-".startswith(f"{name}-") for task in chosen)]
    if unknown:
        kinds = ", ".join(dict.fromkeys(task.kind for task in home_tasks()))
        expected = f"names such as home-3 or home-3-search (1 to 8; {kinds})"
        raise InvalidInputError(f"pairs: expected {expected}, got {', '.join(unknown)}")
    return chosen
