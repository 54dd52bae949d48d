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
_ITERATIONS_FADING = 0.5
_BELIEVED = 4.0
"""How many times what was expected, with care, a step's cost counts for at most, once it is ..."""
_BELIEVED_SHARE = 0.1
"""... more than this share of a frame's time."""


class Stage(StrEnum):
    """What a frame's time goes into, in the order of the loop."""

    DRAWING = "drawing"
    ATTENTION = "attention"
    REEVALUATION = "rereading"
    VIEW = "view"
    SEEDING = "seeding"
    WARM_UP = "warm_up"
    ACTIVE = "active"
    PRUNING = "pruning"
    DENSIFYING = "densifying"
    SETTLING = "settling"
    WORDS = "words"


class SkippableStage(StrEnum):
    """What a frame may go without when its time is short."""

    WORDS = "words"
    """The region's words wait for the next frame, which tells totals anyway."""
    SEEDING = "seeding"
    """Neither look at the map from here nor add to it: the frame only trains."""


_SPARED = {SkippableStage.WORDS: (Stage.WORDS,), SkippableStage.SEEDING: (Stage.DRAWING, Stage.SEEDING)}
_FIXED = frozenset((Stage.DRAWING, Stage.ATTENTION, Stage.VIEW, Stage.SEEDING, Stage.SETTLING, Stage.WORDS))
_ITERATIONS = frozenset((Stage.WARM_UP, Stage.ACTIVE))


@dataclass(frozen=True, slots=True)
class SchedulerSettings:
    """A frame's time, from the image in memory to the region's words.

    min_iterations are trained in every frame. Where the time gets short for them, warm-ups give way to the region's
    iterations, but for the one that a frame begins with, and what can wait for another frame waits; where that does
    not suffice, the reliefs give way in their order, none of them in two frames on end. A frame that is behind in
    spite of it may run over, by the share run_over of its time and for the least iterations alone; the frames after
    it have that much less until it is made up. A frame that trains less even so counts as short.
    """

    seconds_per_frame: float = 0.25
    min_iterations: int = 15
    reliefs: tuple[SkippableStage, ...] = (SkippableStage.WORDS, SkippableStage.SEEDING)
    run_over: float = 0.15

    def __post_init__(self) -> None:
        if not (math.isfinite(self.seconds_per_frame) and self.seconds_per_frame > 0):
            raise InvalidInputError(f"seconds_per_frame: expected a positive number, got {self.seconds_per_frame}")
        if self.min_iterations < 0:
            raise InvalidInputError(f"min_iterations: expected at least 0, got {self.min_iterations}")
        if len(set(self.reliefs)) != len(self.reliefs):
            raise InvalidInputError(f"reliefs: expected each once, got {', '.join(self.reliefs)}")
        if not 0 <= self.run_over <= 1:
            raise InvalidInputError(f"run_over: expected a share of a frame's time, 0 to 1, got {self.run_over}")

    @property
    def run_over_s(self) -> float:
        """The most that a frame may be late, and that frames before it may have taken of its time."""
        return self.run_over * self.seconds_per_frame


@dataclass(frozen=True, slots=True)
class FrameTiming:
    """How one frame's time was spent: in all, on each step, what it went without, and whether it trained too little."""

    seconds: float
    steps_s: Mapping[Stage, float]
    reliefs: frozenset[SkippableStage]
    short: bool


class FrameScheduler:
    """Tells one frame after the other what it has time for. With settings None iterations are counted instead.

    A frame is due once the time of a frame has passed, less what those before it are behind. Time between two frames
    makes up for nothing. What a frame is late by beyond the share that it may run over is forgiven: the rate suffers.
    One that could have been begun before its turn came, because it was there and the frame before it had had its time,
    less that share, is due by as much earlier; its least iterations have their time all the same.
    """

    def __init__(self, settings: SchedulerSettings | None = None, clock: Clock = time.perf_counter) -> None:
        self._settings = settings
        self._clock = clock
        believed_s = math.inf if settings is None else _BELIEVED_SHARE * settings.seconds_per_frame
        self._forecasts = {step: _Forecast(believed_s) for step in Stage}
        self._steps_s: dict[Stage, float] = {}
        self._reliefs: frozenset[SkippableStage] = frozenset()
        self._iterations = 0
        self._cheapest = Stage.WARM_UP
        self._begun_s = clock()
        self._could_begin_s = -math.inf
        self._behind_s = self._waited_s = 0.0
        self._training_due_s = self._least_due_s = 0.0

    def begin(self, waited_s: float = 0.0) -> None:
        """It is a frame's turn: its time runs from now, and what it goes without is decided.

        waited_s is how long it has been there: frames that wait get less, or a queue would never grow shorter. But no
        frame could begin before those ahead of it had their time, or one queue that is always full would leave all of
        them no more than the least.
        """
        for step in Stage:
            if step not in self._steps_s:
                # a frame that has too little time for any would not find out how many it has time for
                self._forecasts[step].fade(_ITERATIONS_FADING if step in _ITERATIONS else _FADING)
        self._cheapest = Stage.ACTIVE if Stage.ACTIVE in self._steps_s else Stage.WARM_UP
        self._begun_s = self._clock()
        self._steps_s, self._iterations = {}, 0
        if self._settings is not None:
            in_turn_s = self._could_begin_s + self._settings.seconds_per_frame - self._settings.run_over_s
            self._could_begin_s = min(self._begun_s, max(self._begun_s - waited_s, in_turn_s))
            self._waited_s = self._begun_s - self._could_begin_s
            self._behind_s = min(max(self._behind_s, self._waited_s), self._settings.run_over_s)
            expected = {step: forecast.mean_s for step, forecast in self._forecasts.items()}
            time_s = self._settings.seconds_per_frame - self._behind_s
            self._reliefs = choose_reliefs(self._settings, time_s, expected, self._reliefs, self._cheapest)
            self._look_ahead()

    def spares(self, relief: SkippableStage) -> bool:
        """True when this frame goes without it."""
        return relief in self._reliefs

    def has_time_for(self, step: Stage) -> bool:
        """True when with this step the frame is expected to be done in time, its least iterations among the rest."""
        if self._settings is None:
            return True
        missing = max(0, self._settings.min_iterations - self._iterations - (step in _ITERATIONS))
        needed_s = self._forecasts[step].cautious_s + missing * self._forecasts[self._cheapest].mean_s
        return self._clock() + needed_s < self._training_due_s

    def trains_on(self, step: Stage, counted: int) -> bool:
        """True while the frame goes on training: another iteration fits, or (untimed) fewer than `counted` are done.

        The first of the least iterations is trained whatever time is left.
        """
        if self._settings is None or counted == 0:
            return self._iterations < counted
        too_few = self._iterations < self._settings.min_iterations
        if too_few and self._iterations == 0:
            return True
        due_s = self._least_due_s if too_few else self._training_due_s
        return self._clock() + self._forecasts[step].cautious_s < due_s

    def timing(self, step: Stage) -> AbstractContextManager[None]:
        """Measure a step, and expect the next of its kind to cost about as much."""
        return _Timing(self._clock, partial(self._took, step))

    def _took(self, step: Stage, seconds: float) -> None:
        self._steps_s[step] = self._steps_s.get(step, 0.0) + seconds
        self._forecasts[step].learn(seconds)
        if step in _ITERATIONS:
            self._iterations += 1
        if step is Stage.ACTIVE:
            self._cheapest = step
        elif step in _FIXED and self._settings is not None:
            self._look_ahead()

    def end(self) -> FrameTiming:
        """The frame is done; what it took beyond its time is missing to the next ones."""
        seconds = self._clock() - self._begun_s
        short = False
        if self._settings is not None:
            behind_s = self._behind_s + seconds - self._settings.seconds_per_frame
            self._behind_s = min(max(behind_s, 0.0), self._settings.run_over_s)
            short = self._iterations < self._settings.min_iterations
        return FrameTiming(seconds, dict(self._steps_s), self._reliefs, short)

    def _look_ahead(self) -> None:
        """Until when the frame may train or do what can wait, and until when its least iterations may take, so that it
        still does in time what it must.
        """
        assert self._settings is not None
        spared = {step for relief in self._reliefs for step in _SPARED[relief]}
        ahead = _FIXED - spared - self._steps_s.keys()
        training_s = self._settings.seconds_per_frame - sum(self._forecasts[step].cautious_s for step in ahead)
        self._training_due_s = self._begun_s + training_s - max(self._behind_s, self._waited_s)
        self._least_due_s = self._begun_s + training_s - self._behind_s + self._settings.run_over_s


def choose_reliefs(
    settings: SchedulerSettings,
    time_s: float,
    expected_s: Mapping[Stage, float],
    before: frozenset[SkippableStage],
    cheapest: Stage,
) -> frozenset[SkippableStage]:
    """What to go without so that the least iterations fit into this time.

    expected_s: what each step costs; before: what the frame before went without; cheapest: of what kind iterations may
    be, all but the warm-up that a frame begins with.
    """
    needed_s = sum(expected_s[step] for step in _FIXED)
    if settings.min_iterations > 0:
        needed_s += expected_s[Stage.WARM_UP] + (settings.min_iterations - 1) * expected_s[cheapest]
    chosen: set[SkippableStage] = set()
    for relief in settings.reliefs:
        if needed_s > time_s and relief not in before:
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
    """What a step will cost: its running mean and as much again as it usually strays from that.

    A time far above that says more about the machine (it stood still, it swapped) than about the step, and is believed
    in part. One up to believed_s is believed whole, and so is the first.
    """

    def __init__(self, believed_s: float) -> None:
        self._believed_s = believed_s
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
        surprise_s = min(seconds, max(_BELIEVED * self.cautious_s, self._believed_s)) - self._mean_s
        self._mean_s += _LEARNING * surprise_s
        self._spread_s += _LEARNING * (abs(surprise_s) - self._spread_s)

    def fade(self, share: float) -> None:
        """Expect less of what was not tried, so that one slow time does not rule it out for good."""
        self._mean_s = None if self._mean_s is None else share * self._mean_s
        self._spread_s *= share
