"""Name the ways to spend a budget: for the task, or evenly over everything."""

from __future__ import annotations

from collections.abc import Callable

from gausslite.errors import InvalidInputError
from gausslite.mapping.settings import Components, MapperSettings


def task_policy() -> MapperSettings:
    """All five components of the paper."""
    return MapperSettings()


def uniform_policy() -> MapperSettings:
    """The baseline: uniform seeds and full-image training on the same window of views, at the same budget."""
    return MapperSettings(components=Components(sb=False, mvo=True, roi=False, sis=False, gfd=False))


POLICIES: dict[str, Callable[[], MapperSettings]] = {"task": task_policy, "uniform": uniform_policy}


def policy(name: str) -> MapperSettings:
    """The settings of a named policy. Raises InvalidInputError for a name that is not in POLICIES."""
    if name not in POLICIES:
        raise InvalidInputError(f"policy: expected one of {', '.join(POLICIES)}, got {name!r}")
    return POLICIES[name]()
