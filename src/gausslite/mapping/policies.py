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


PAPER_FLAGS = ("sb", "mvo", "roi", "sis", "gfd")
"""The paper's components (Sec. III-C, III-D), in the order of its ablation."""

EXTENSION_FLAGS: dict[str, Callable[[MapperSettings], MapperSettings]] = {
    "long-term-keyframes": lambda settings: replace(settings, keyframes=replace(settings.keyframes, long_term_keyframes=0)),
    "roi-context": lambda settings: replace(settings, keyframes=replace(settings.keyframes, roi_context_weight=0.0)),
    "background-reserve": lambda settings: replace(settings, seeding=replace(settings.seeding, background_share=0.0)),
    "ema": lambda settings: replace(settings, optimization=replace(settings.optimization, ema_updates=0.0)),
    "lr-decay": lambda settings: replace(
        settings, optimization=replace(settings.optimization, decay_after_updates=math.inf)
    ),
}
"""What came beyond the paper, in the order of our ablation, and how each is switched off."""

ABLATION_FLAGS = (*PAPER_FLAGS, *EXTENSION_FLAGS)


def disable(settings: MapperSettings, names: Collection[str]) -> MapperSettings:
    """These settings with the named parts switched off. Raises InvalidInputError for a name that is none of them."""
    unknown = sorted(set(names) - set(ABLATION_FLAGS))
    if unknown:
        raise InvalidInputError(f"disable: expected names among {', '.join(ABLATION_FLAGS)}, got {', '.join(unknown)}")
    off = dict.fromkeys((name for name in PAPER_FLAGS if name in names), False)
    settings = replace(settings, components=replace(settings.components, **off))
    for name in (each for each in EXTENSION_FLAGS if each in names):
        settings = EXTENSION_FLAGS[name](settings)
    return settings
