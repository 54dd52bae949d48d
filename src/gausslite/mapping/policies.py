"""Name the ways to spend a budget: for the task, or evenly over everything."""

from __future__ import annotations

from collections.abc import Callable

from gausslite.errors import InvalidInputError
from gausslite.mapping.baselines import gaussian_slam_policy, monogs_policy, splatam_policy, uniform_policy
from gausslite.mapping.settings import MapperSettings


def task_policy() -> MapperSettings:
    """All five components of the paper."""
    return MapperSettings()


TASK = "task"
"""The one policy that asks what matters; the others map everything alike."""

POLICIES: dict[str, Callable[[], MapperSettings]] = {
    TASK: task_policy,
    "uniform": uniform_policy,
    "gaussian-slam": gaussian_slam_policy,
    "splatam": splatam_policy,
    "monogs": monogs_policy,
}


def policy(name: str) -> MapperSettings:
    """The settings of a named policy. Raises InvalidInputError for a name that is not in POLICIES."""
    if name not in POLICIES:
        raise InvalidInputError(f"policy: expected one of {', '.join(POLICIES)}, got {name!r}")
    return POLICIES[name]()
