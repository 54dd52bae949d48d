"""Divide the time of each frame: forecast the duration of every stage, and train for the rest of the time."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import partial

from gausslite.domain.errors import InvalidInputError
from gausslite.mapping.stages import ITERATION_STAGES, SkippableStage, Stage

Clock = Callable[[], float]
"""Monotonic seconds from an arbitrary start."""

_EMA_WEIGHT = 0.2
_FADE_PER_FRAME = 0.95
_ITERATION_FADE_PER_FRAME = 0.5
_OUTLIER_FACTOR = 4.0
"""Measured durations are clipped to this multiple of their cautious forecast."""
_OUTLIER_SHARE = 0.1
"""Durations below this share of a frame's time are never clipped."""

_STAGES_SKIPPED = {
    SkippableStage.PUBLISHING: (Stage.PUBLISHING,),
    SkippableStage.SEEDING: (Stage.RENDERING, Stage.SEEDING),
}
_FIXED_STAGES = frozenset(
    (
        *(Stage.TRACKING, Stage.RENDERING, Stage.RELEVANCE, Stage.VIEW_PREPARATION),
        *(Stage.SEEDING, Stage.FINALISATION, Stage.PUBLISHING),
    )
)


@dataclass(frozen=True, slots=True)
class SchedulerSettings:
    """Time of one frame, from the image in memory to the published voxels of the region.

    Each frame trains min_iterations. If the time is too short for them, the scheduler saves time in this order:
    iterations over the region replace all warm-up iterations but the first; optional stages wait for a later frame;
    skip_stages are skipped in their order, none of them in two consecutive frames. A frame that still overruns may
    exceed its deadline by the share deadline_slack, for its min_iterations only. The overrun is deducted from the
    following frames. A frame with fewer iterations counts as under-trained.
    """

    seconds_per_frame: float = 0.25  # 1 / rate
    min_iterations: int = 15
    skip_stages: tuple[SkippableStage, ...] = (SkippableStage.PUBLISHING, SkippableStage.SEEDING)
    deadline_slack: float = 0.15

    def __post_init__(self) -> None:
        if not (math.isfinite(self.seconds_per_frame) and self.seconds_per_frame > 0):
            raise InvalidInputError(f"seconds_per_frame: expected a positive number, got {self.seconds_per_frame}")

    @property
    def deadline_slack_s(self) -> float:
        """The longest overrun of a frame, and the largest reduction of a frame's time by earlier overruns."""
        return self.deadline_slack * self.seconds_per_frame


@dataclass(frozen=True, slots=True)
class FrameTiming:
    """Time of one frame in total and by stage, and its skipped stages."""

    seconds: float  # from its arrival at the mapper
    stages_s: Mapping[Stage, float]
    skipped_stages: frozenset[SkippableStage]
    under_trained: bool  # it trained fewer than min_iterations
    late: bool = False  # it ended after its deadline and the slack, so that the rate falls


class FrameScheduler:
    """A StageScheduler with a clock: it measures every frame, and with settings it also enforces deadlines.

    Without settings, each frame trains a fixed number of iterations and no stage is skipped.

    A frame's deadline is its start plus seconds_per_frame, less the overrun of earlier frames. Idle time between
    frames does not extend it. An overrun beyond deadline_slack is not recovered, so the rate falls. A frame that waited
    in the queue gets an earlier deadline, see `begin`. The time of its min_iterations is never reduced.
    """

    def __init__(self, settings: SchedulerSettings | None = None, clock: Clock = time.perf_counter) -> None:
        self._settings = settings
        self._clock = clock
        outlier_s = math.inf if settings is None else _OUTLIER_SHARE * settings.seconds_per_frame
        self._forecasts = {stage: _Forecast(outlier_s) for stage in Stage}
        self._stages_s: dict[Stage, float] = {}
        self._skipped: frozenset[SkippableStage] = frozenset()
        self._iterations = 0
        self._cheapest_iteration = Stage.WARM_UP
        self._begin_s = clock()
        self._earliest_begin_s = -math.inf
        self._behind_s = self._waited_s = 0.0
        self._training_deadline_s = self._min_iterations_deadline_s = 0.0

    def begin(self, waited_s: float = 0.0) -> None:
        """Start the time of a frame and choose the stages that it skips.

        waited_s is the frame's time in the queue. A frame that waited gets less time, so that the queue becomes
        shorter. The deduction is limited to the time since the frame before it was due; otherwise every frame behind a
        full queue would get min_iterations only.
        """
        for stage in Stage:
            if stage not in self._stages_s:
                # without this, a stage with a long forecast would never run again
                fade = _ITERATION_FADE_PER_FRAME if stage in ITERATION_STAGES else _FADE_PER_FRAME
                self._forecasts[stage].decay(fade)
        self._cheapest_iteration = Stage.ACTIVE if Stage.ACTIVE in self._stages_s else Stage.WARM_UP
        self._begin_s = self._clock()
        self._stages_s, self._iterations = {}, 0
        if self._settings is not None:
            self._set_deadlines_of_frame(self._settings, waited_s)

    def _set_deadlines_of_frame(self, settings: SchedulerSettings, waited_s: float) -> None:
        after_previous_s = self._earliest_begin_s + settings.seconds_per_frame - settings.deadline_slack_s
        self._earliest_begin_s = min(self._begin_s, max(self._begin_s - waited_s, after_previous_s))
        self._waited_s = self._begin_s - self._earliest_begin_s
        self._behind_s = min(max(self._behind_s, self._waited_s), settings.deadline_slack_s)
        expected_s = {stage: forecast.mean_s for stage, forecast in self._forecasts.items()}
        available_s = settings.seconds_per_frame - self._behind_s
        self._skipped = choose_skipped_stages(
            settings, available_s, expected_s, self._skipped, self._cheapest_iteration
        )
        self._update_deadlines(settings)

    def skips(self, stage: SkippableStage) -> bool:
        """Return True if the current frame skips this stage."""
        return stage in self._skipped

    def has_time_for(self, stage: Stage) -> bool:
        """Return True if the frame is expected to meet its deadline with this stage and its min_iterations."""
        if self._settings is None:
            return True
        missing = max(0, self._settings.min_iterations - self._iterations - (stage in ITERATION_STAGES))
        needed_s = self._forecasts[stage].upper_s + missing * self._forecasts[self._cheapest_iteration].mean_s
        return self._clock() + needed_s < self._training_deadline_s

    def trains_on(self, stage: Stage, iterations_per_frame: int) -> bool:
        """Return True for the first of min_iterations, and while another one fits (or is left, without settings)."""
        if self._settings is None or iterations_per_frame == 0:
            return self._iterations < iterations_per_frame
        below_minimum = self._iterations < self._settings.min_iterations
        if below_minimum and self._iterations == 0:
            return True
        deadline_s = self._min_iterations_deadline_s if below_minimum else self._training_deadline_s
        return self._clock() + self._forecasts[stage].upper_s < deadline_s

    def timing(self, stage: Stage) -> AbstractContextManager[None]:
        """Return a context that measures one execution of the stage and updates its forecast."""
        return _Stopwatch(self._clock, partial(self._record, stage))

    def _record(self, stage: Stage, seconds: float) -> None:
        self._stages_s[stage] = self._stages_s.get(stage, 0.0) + seconds
        self._forecasts[stage].update(seconds)
        if stage in ITERATION_STAGES:
            self._iterations += 1
        if stage is Stage.ACTIVE:
            self._cheapest_iteration = stage
        elif stage in _FIXED_STAGES and self._settings is not None:
            self._update_deadlines(self._settings)

    def end(self) -> FrameTiming:
        """Return the timing of the current frame and carry its overrun to the next one."""
        seconds = self._clock() - self._begin_s
        under_trained = late = False
        if self._settings is not None:
            behind_s = self._behind_s + seconds - self._settings.seconds_per_frame
            # a longer overrun is given up, or it would starve the frames to come
            self._behind_s = min(max(behind_s, 0.0), self._settings.deadline_slack_s)
            late = behind_s > self._settings.deadline_slack_s
            under_trained = self._iterations < self._settings.min_iterations
        return FrameTiming(seconds, dict(self._stages_s), self._skipped, under_trained, late)

    def _update_deadlines(self, settings: SchedulerSettings) -> None:
        """Set the deadlines of all training and of the min_iterations, reserving time for the fixed stages to come."""
        skipped = {stage for skippable in self._skipped for stage in _STAGES_SKIPPED[skippable]}
        remaining = _FIXED_STAGES - skipped - self._stages_s.keys()
        training_s = settings.seconds_per_frame - sum(self._forecasts[stage].upper_s for stage in remaining)
        self._training_deadline_s = self._begin_s + training_s - max(self._behind_s, self._waited_s)
        self._min_iterations_deadline_s = self._begin_s + training_s - self._behind_s + settings.deadline_slack_s


def choose_skipped_stages(
    settings: SchedulerSettings,
    available_s: float,
    expected_s: Mapping[Stage, float],
    skipped_before: frozenset[SkippableStage],
    cheapest_iteration: Stage,
) -> frozenset[SkippableStage]:
    """Return the stages to skip so that min_iterations fit into the available time.

    expected_s: forecast of each stage; skipped_before: what the previous frame skipped; cheapest_iteration: the kind
    of all iterations after the first, which is a warm-up.
    """
    needed_s = sum(expected_s[stage] for stage in _FIXED_STAGES)
    if settings.min_iterations > 0:
        needed_s += expected_s[Stage.WARM_UP] + (settings.min_iterations - 1) * expected_s[cheapest_iteration]
    chosen: set[SkippableStage] = set()
    for skippable in settings.skip_stages:
        # never the same twice: each runs at half the rate
        if needed_s > available_s and skippable not in skipped_before:
            chosen.add(skippable)
            needed_s -= sum(expected_s[stage] for stage in _STAGES_SKIPPED[skippable])
    return frozenset(chosen)


class _Stopwatch:
    """Report the duration of a block that did not raise. A generator-based context would cost more per iteration."""

    __slots__ = ("_clock", "_report", "_start_s")

    def __init__(self, clock: Clock, report: Callable[[float], None]) -> None:
        self._clock = clock
        self._report = report
        self._start_s = 0.0

    def __enter__(self) -> None:
        self._start_s = self._clock()

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            self._report(self._clock() - self._start_s)


class _Forecast:
    """Forecast of a stage's duration: its EMA, and the EMA of its absolute deviation.

    Much longer durations are caused by the machine (suspended, swapping) rather than the stage, so they are clipped.
    Durations up to outlier_s, and the first one, are not clipped.
    """

    def __init__(self, outlier_s: float) -> None:
        self._outlier_s = outlier_s
        self._mean_s: float | None = None
        self._deviation_s = 0.0

    @property
    def mean_s(self) -> float:
        return self._mean_s or 0.0

    @property
    def upper_s(self) -> float:
        """The mean plus the mean deviation."""
        return self.mean_s + self._deviation_s

    def update(self, seconds: float) -> None:
        if self._mean_s is None:
            self._mean_s = seconds
            return
        error_s = min(seconds, max(_OUTLIER_FACTOR * self.upper_s, self._outlier_s)) - self._mean_s
        self._mean_s += _EMA_WEIGHT * error_s
        self._deviation_s += _EMA_WEIGHT * (abs(error_s) - self._deviation_s)

    def decay(self, share: float) -> None:
        """Lower the forecast of a stage that did not run, so that it runs again some time after a slow run."""
        self._mean_s = None if self._mean_s is None else share * self._mean_s
        self._deviation_s *= share
