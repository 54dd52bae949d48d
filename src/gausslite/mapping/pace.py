"""Give each frame its time: expect what every step costs from the past, and fill what is left with iterations."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from enum import StrEnum
from functools import partial

from gausslite.errors import InvalidInputError

Clock = Callable[[], float]
"""Seconds since some moment; never runs backwards."""

_LEARNING = 0.2
_FADING = 0.95


class Step(StrEnum):
    """What a frame's time goes into, in the order of the loop."""

    DRAWING = "drawing"
    ATTENTION = "attention"
    REREADING = "rereading"
    VIEW = "view"
    SEEDING = "seeding"
    WARM_UP = "warm_up"
    ACTIVE = "active"
    DENSITY = "density"
    SETTLING = "settling"
    WORDS = "words"


class Relief(StrEnum):
    """What a frame may go without when its time is short."""

    WORDS = "words"
    """The region's words wait for the next frame, which tells totals anyway."""
    SEEDING = "seeding"
    """Neither look at the map from here nor add to it: the frame only trains."""


_SPARED = {Relief.WORDS: (Step.WORDS,), Relief.SEEDING: (Step.DRAWING, Step.SEEDING)}
_FIXED = (Step.DRAWING, Step.ATTENTION, Step.VIEW, Step.SEEDING, Step.SETTLING, Step.WORDS)


@dataclass(frozen=True, slots=True)
class PaceSettings:
    """A frame's time, from the image in memory to the region's words.

    least_iterations are trained in every frame. Where the time gets short for them, warm-ups give way to the region's
    iterations, but for those that a frame begins with; where it does not suffice, the reliefs give way in their order,
    none of them in two frames on end; where it still does not, the frame trains less and counts as short.
    """

    seconds_per_frame: float = 0.25
    least_iterations: int = 15
    reliefs: tuple[Relief, ...] = (Relief.WORDS, Relief.SEEDING)

    def __post_init__(self) -> None:
        if not (math.isfinite(self.seconds_per_frame) and self.seconds_per_frame > 0):
            raise InvalidInputError(f"seconds_per_frame: expected a positive number, got {self.seconds_per_frame}")
        if self.least_iterations < 0:
            raise InvalidInputError(f"least_iterations: expected at least 0, got {self.least_iterations}")
        if len(set(self.reliefs)) != len(self.reliefs):
            raise InvalidInputError(f"reliefs: expected each once, got {', '.join(self.reliefs)}")


@dataclass(frozen=True, slots=True)
class FrameBudget:
    """How one frame's time was spent: in all, on each step, what it went without, and whether it trained too little."""

    seconds: float
    steps_s: Mapping[Step, float]
    reliefs: frozenset[Relief]
    short: bool


class Pace:
    """Tells one frame after the other what it has time for. With settings None iterations are counted instead."""

    def __init__(self, settings: PaceSettings | None = None, clock: Clock = time.perf_counter) -> None:
        self._settings = settings
        self._clock = clock
        self._forecasts = {step: _Forecast() for step in Step}
        self._steps_s: dict[Step, float] = {}
        self._reliefs: frozenset[Relief] = frozenset()
        self._begun_s = clock()
        self._iterations = 0
        self._opening = 0

    def begin(self) -> None:
        """A frame has come: its time runs from now, and what it goes without is decided."""
        for step in Step:
            if step not in self._steps_s:
                self._forecasts[step].fade()
        self._begun_s = self._clock()
        if self._settings is not None:
            expected = {step: forecast.mean_s for step, forecast in self._forecasts.items()}
            self._reliefs = choose_reliefs(self._settings, expected, self._reliefs, self._opening)
        self._steps_s, self._iterations, self._opening = {}, 0, 0

    def spares(self, relief: Relief) -> bool:
        """True when this frame goes without it."""
        return relief in self._reliefs

    def has_time_for(self, step: Step) -> bool:
        """True when the step is expected to end in time for what must follow it."""
        return self._settings is None or self._left_s() > self._forecasts[step].cautious_s

    def trains_on(self, step: Step, counted: int) -> bool:
        """True while the frame goes on training: another iteration fits, or (untimed) fewer than `counted` are done."""
        if self._settings is None or counted == 0:
            return self._iterations < counted
        return self._left_s() > self._forecasts[step].cautious_s

    def affords(self, step: Step, cheaper: Step) -> bool:
        """True when after this iteration the frame still reaches its least number of them with the cheaper kind."""
        if self._settings is None:
            return True
        missing = max(0, self._settings.least_iterations - self._iterations - 1)
        needed_s = self._forecasts[step].cautious_s + missing * self._forecasts[cheaper].mean_s
        return self._left_s() > needed_s

    def timing(self, step: Step) -> AbstractContextManager[None]:
        """Measure a step, and expect the next of its kind to cost about as much."""
        return _Timing(self._clock, partial(self._took, step))

    def _took(self, step: Step, seconds: float) -> None:
        self._steps_s[step] = self._steps_s.get(step, 0.0) + seconds
        self._forecasts[step].learn(seconds)
        self._opening += step is Step.WARM_UP and self._opening == self._iterations
        self._iterations += step in (Step.WARM_UP, Step.ACTIVE)

    def end(self) -> FrameBudget:
        """The frame is done."""
        least = 0 if self._settings is None else self._settings.least_iterations
        seconds = self._clock() - self._begun_s
        return FrameBudget(seconds, dict(self._steps_s), self._reliefs, self._iterations < least)

    def _left_s(self) -> float:
        """What is left of the frame's time once what follows training is done: the means carried on, the words made."""
        assert self._settings is not None
        later_s = 0.0 if self.spares(Relief.WORDS) else self._forecasts[Step.WORDS].cautious_s
        if Step.SETTLING not in self._steps_s:
            later_s += self._forecasts[Step.SETTLING].cautious_s
        return self._begun_s + self._settings.seconds_per_frame - self._clock() - later_s


def choose_reliefs(
    settings: PaceSettings, expected_s: Mapping[Step, float], before: frozenset[Relief], opening: int
) -> frozenset[Relief]:
    """What to go without so that the least iterations fit, given what each step costs and what the frame before spared.

    opening: with how many warm-ups a frame begins.
    """
    warm_ups = min(opening, settings.least_iterations)
    needed_s = sum(expected_s[step] for step in _FIXED) + warm_ups * expected_s[Step.WARM_UP]
    needed_s += (settings.least_iterations - warm_ups) * expected_s[Step.ACTIVE]
    chosen: set[Relief] = set()
    for relief in settings.reliefs:
        if needed_s > settings.seconds_per_frame and relief not in before:
            chosen.add(relief)
            needed_s -= sum(expected_s[step] for step in _SPARED[relief])
    return frozenset(chosen)


class _Timing:
    """Tells how long its block took, unless that raised; round every iteration a generator would cost more."""

    __slots__ = ("_clock", "_started_s", "_tell")

    def __init__(self, clock: Clock, tell: Callable[[float], None]) -> None:
        self._clock = clock
        self._tell = tell
        self._started_s = 0.0

    def __enter__(self) -> None:
        self._started_s = self._clock()

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            self._tell(self._clock() - self._started_s)


class _Forecast:
    """What a step will cost: its running mean and as much again as it usually strays from that."""

    def __init__(self) -> None:
        self._mean_s: float | None = None
        self._spread_s = 0.0

    @property
    def mean_s(self) -> float:
        return self._mean_s or 0.0

    @property
    def cautious_s(self) -> float:
        return self.mean_s + self._spread_s

    def learn(self, seconds: float) -> None:
        if self._mean_s is None:
            self._mean_s = seconds
            return
        surprise_s = seconds - self._mean_s
        self._mean_s += _LEARNING * surprise_s
        self._spread_s += _LEARNING * (abs(surprise_s) - self._spread_s)

    def fade(self) -> None:
        """Expect less of what was not tried, so that one slow time does not rule it out for good."""
        self._mean_s = None if self._mean_s is None else _FADING * self._mean_s
        self._spread_s *= _FADING
