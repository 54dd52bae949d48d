"""The frame loop of every mission: read a frame, process it, report it, until the end or an interrupt."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace

from gausslite.datasets.calibration import StatedValues, open_calibrator
from gausslite.datasets.open import open_source
from gausslite.datasets.source import HeldOutSplit, Source, frame_size, select_frames
from gausslite.domain.errors import DatasetError, GaussLiteError, PoseError
from gausslite.domain.frame import Frame
from gausslite.domain.recording import CameraCorrection, PoseExposurePrior
from gausslite.mission.localisation_monitor import UNPLACED
from gausslite.mission.settings import SourceSettings
from gausslite.mission.task_mapper import TRACKING_LOST, FrameOutcome
from gausslite.process import DeferredInterrupt

OnCorrupt = Callable[[int, DatasetError | PoseError], None]
"""Gets the index and the error of each frame that cannot be read."""
_NO_FRAME_INDEX = -1


def ground_truth_notes(spec: str, source: Source) -> tuple[str, ...]:
    """Return a message if the sequence has ground-truth regions, which find objects without a detector."""
    file = source.regions_file
    origin = f"{file.name} in the sequence's folder" if file else "the sequence" if source.regions() else ""
    return (f"{spec}: no detector: the ground-truth regions of {origin} are used",) if origin else ()


@dataclass(frozen=True, slots=True)
class FrameStream:
    """The selected positions of a sequence and the size of their images."""

    source: Source
    positions: Sequence[int]
    size: tuple[int, int]

    @classmethod
    def open(cls, settings: SourceSettings) -> FrameStream:
        """Open the sequence of the settings, registered and corrected, and select its frames.

        Without a stated correction, the lens that the files state is corrected. Raises DatasetError, PoseError,
        InvalidInputError.
        """
        source = open_source(settings.spec, settings.up_axis, settings.depth_registration, settings.require_poses)
        correction = settings.camera_correction or CameraCorrection(source.lens)
        stated = StatedValues.all_of(None, correction, PoseExposurePrior())
        return cls.select(open_calibrator().calibrate(source, stated).source, settings)

    @classmethod
    def select(cls, source: Source, settings: SourceSettings) -> FrameStream:
        """Return the selected frames without those held out. Raises DatasetError for none, InvalidInputError."""
        positions: Sequence[int] = select_frames(source, settings.frames)
        if settings.test_every is not None:
            positions, _ = HeldOutSplit(settings.test_every).split(positions)
        return cls(source, positions, frame_size(settings.size, source))

    def __len__(self) -> int:
        return len(self.positions)

    def after(self, index: int) -> FrameStream:
        """Return the frames with a greater index."""
        indices = self.source.indices()
        return replace(self, positions=[position for position in self.positions if indices[position] > index])

    def frames(self, on_corrupt: OnCorrupt | None = None) -> Iterator[Frame]:
        """Yield each frame, read on request; errors of unreadable ones go to on_corrupt, or are raised without it."""
        for position in self.positions:
            try:
                frame = self.source.frame(position, self.size)
            except (DatasetError, PoseError) as error:
                if on_corrupt is None:
                    raise
                on_corrupt(self.source.indices()[position], error)
                continue
            yield frame


class CorruptFrames:
    """Count the frames that cannot be read, and report each of them."""

    def __init__(self, report: Callable[[str], None]) -> None:
        self._report = report
        self.count = 0
        self.first_error: DatasetError | PoseError | None = None

    def __call__(self, index: int, error: DatasetError | PoseError) -> None:
        """Count one frame and report its error, which names the file."""
        self.count += 1
        self.first_error = self.first_error or error
        self._report(f"frame {index} skipped: {error}")


@dataclass(slots=True)
class MissionTotals:
    """Sums over the frames of a mission."""

    frames: int = 0  # mapped ones
    joined: int = 0  # those of them that were mapped apart, without the task
    reasons: Counter[str] = field(default_factory=Counter)  # of the skipped frames
    late: int = 0  # those of them that missed their deadline
    iterations: int = 0
    keyframes_reevaluated: int = 0
    seeded_in_keyframes: int = 0
    roi_share_sum: float = 0.0
    busy_s: float = 0.0  # time of processing
    region_seen: bool = False  # a frame has shown the task's region

    @property
    def hz(self) -> float:
        """Mapped frames per second of perception and mapping, without reading files."""
        return (self.frames - self.joined) / self.busy_s if self.busy_s > 0 else 0.0

    @property
    def skipped(self) -> int:
        """Number of frames that were not mapped."""
        return self.reasons.total()

    @property
    def lost(self) -> int:
        """Number of frames that tracking has lost."""
        return self.reasons[TRACKING_LOST]

    def add(self, outcome: FrameOutcome) -> None:
        """Add one frame."""
        for waited in outcome.recovered:
            self.reasons[UNPLACED] -= 1
            self.add(waited)
        # a resumed mission has not counted those from before
        joined = min(outcome.joined, self.reasons[UNPLACED])
        self.frames, self.joined = self.frames + joined, self.joined + joined
        self.reasons -= Counter({UNPLACED: joined})
        self.keyframes_reevaluated += outcome.reevaluation.keyframes
        self.seeded_in_keyframes += outcome.reevaluation.seeded
        self.region_seen |= outcome.roi_share > 0
        if outcome.skipped is not None:
            self.reasons[outcome.skipped] += 1
            return
        self.frames += 1
        self.late += outcome.timing.late
        self.iterations += outcome.iterations
        self.roi_share_sum += outcome.roi_share
        self.busy_s += outcome.timing.seconds


@dataclass(frozen=True, slots=True)
class MissionResult:
    """Result of a mission."""

    totals: MissionTotals  # sums over its frames
    seconds: float  # wall time
    last_index: int  # index of the last processed frame, or the index that the run was resumed after
    stopped_by: GaussLiteError | KeyboardInterrupt | None  # the error or interrupt that ended it early

    @property
    def processed(self) -> int:
        """Number of frames, including skipped ones."""
        return self.totals.frames + self.totals.skipped

    def raise_if_stopped(self) -> None:
        """Raise the error or interrupt that ended the mission early."""
        if self.stopped_by is not None:
            raise self.stopped_by

    def summary(self) -> dict[str, object]:
        """Return the totals as part of a report."""
        totals = self.totals
        return {
            "frames": totals.frames,
            "frames_skipped": totals.skipped,
            "frames_late": totals.late,
            "iterations": totals.iterations,
            "roi_share": totals.roi_share_sum / max(totals.frames - totals.joined, 1),
            "keyframes_reevaluated": totals.keyframes_reevaluated,
            "seeded_in_keyframes": totals.seeded_in_keyframes,
            "hz": totals.hz,
            "seconds": self.seconds,
            "stopped_by": None if self.stopped_by is None else str(self.stopped_by) or "interrupted",
        }


@dataclass(frozen=True, slots=True)
class MissionRunner:
    """Pass frames to a processing step, one after the other.

    should_stop: called before each frame; the run ends if it returns True. Publishing is part of the processing step,
    see `TaskMapper`.
    """

    process: Callable[[Frame], FrameOutcome | None]  # maps one frame, or queues it elsewhere and returns None
    on_frame: Callable[[FrameOutcome], None] = lambda _outcome: None  # gets each outcome, for progress
    should_stop: Callable[[], bool] = field(default=lambda: False)

    def run(self, frames: Iterable[Frame], resumed_after: int = _NO_FRAME_INDEX) -> MissionResult:
        """Process all frames. Ctrl-C and SIGTERM end the run after the current frame.

        An error of the frames or of the processing step ends the run too; the result holds it.
        """
        start_s = time.perf_counter()
        totals, last_index = MissionTotals(), resumed_after
        stopped_by: GaussLiteError | KeyboardInterrupt | None = None
        source = iter(frames)
        with DeferredInterrupt() as interrupt:
            while not self.should_stop():
                if interrupt.pending_exception is not None:
                    stopped_by = interrupt.pending_exception
                    break
                try:
                    frame = next(source, None)
                    if frame is None:
                        break
                    outcome = self.process(frame)
                except GaussLiteError as error:
                    stopped_by = error
                    break
                last_index = frame.index
                if outcome is not None:
                    totals.add(outcome)
                    self.on_frame(outcome)
        return MissionResult(totals, time.perf_counter() - start_s, last_index, stopped_by)
