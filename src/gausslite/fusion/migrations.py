"""Find the steps that bring a store of an earlier schema forward, a plug-in of `gausslite.migrations`."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from gausslite.domain.errors import StorageError
from gausslite.plugins import Group, load

Query = Callable[[str, tuple[Any, ...]], Iterable[tuple[Any, ...]]]
"""Executes a statement, with ? for each value, in the transaction that is open; returns its rows."""
Step = Callable[[Query], None]
"""Leads from one schema to the next."""


def missing_steps(store: str, version: int, current: int) -> tuple[Step, ...]:
    """Return the steps from this schema version to the current one. Raises StorageError if there are none.

    Raises MissingPluginError for an earlier version without the plug-in.
    """
    if version == current:
        return ()
    steps: tuple[Step, ...] = load(Group.MIGRATIONS, purpose=f"store {store} of schema version {version}")
    if not 0 <= current - version <= len(steps):
        raise StorageError(
            f"store {store}: expected schema version {current - len(steps)} to {current}, got {version} of another "
            "release; use that release, or another store, and the agents send their updates again"
        )
    return steps[len(steps) - (current - version) :]
