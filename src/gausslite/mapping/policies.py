"""Name the ways to spend a budget, for the task or evenly over everything, and what can be switched off in them."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection
from dataclasses import replace

from gausslite.errors import InvalidInputError
from gausslite.mapping.baselines import gaussian_slam_policy, monogs_policy, splatam_policy, uniform_policy
from gausslite.mapping.settings import MapperSettings


def task_policy() -> MapperSettings:
    """All five components of the paper, and what came to stay beyond it."""
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


PAPER_ABLATION_FLAGS = ("sb", "mvo", "roi", "sis", "gfd")
"""The paper's components (Sec. III-C, III-D), in the order of its ablation."""

BEYOND_SWITCHES: dict[str, Callable[[MapperSettings], MapperSettings]] = {
    "views": lambda settings: replace(settings, keyframes=replace(settings.keyframes, region_views=0)),
    "surroundings": lambda settings: replace(settings, keyframes=replace(settings.keyframes, surroundings_weight=0.0)),
    "scaffold": lambda settings: replace(settings, seeding=replace(settings.seeding, scaffold_share=0.0)),
    "means": lambda settings: replace(settings, optimization=replace(settings.optimization, averaged_updates=0.0)),
    "settling": lambda settings: replace(
        settings, optimization=replace(settings.optimization, settling_updates=math.inf)
    ),
}
"""What came beyond the paper, in the order of our ablation, and how each is switched off."""

ABLATION_FLAGS = (*PAPER_ABLATION_FLAGS, *BEYOND_SWITCHES)


def without(settings: MapperSettings, names: Collection[str]) -> MapperSettings:
    """These settings with the named parts switched off. Raises InvalidInputError for a name that is none of them."""
    unknown = sorted(set(names) - set(ABLATION_FLAGS))
    if unknown:
        raise InvalidInputError(f"without: expected names among {', '.join(ABLATION_FLAGS)}, got {', '.join(unknown)}")
    off = dict.fromkeys((name for name in PAPER_ABLATION_FLAGS if name in names), False)
    settings = replace(settings, components=replace(settings.components, **off))
    for name in (each for each in BEYOND_SWITCHES if each in names):
        settings = BEYOND_SWITCHES[name](settings)
    return settings
