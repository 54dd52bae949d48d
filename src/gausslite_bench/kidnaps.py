"""Carry, cover and restart a robot in a recording: is it noticed, is it found, and what does the map keep of it?

Each event begins after the same frames. Its map is compared with that of the same frames at their own poses.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.cli.progress import progress_bar
from gausslite.config.option import option
from gausslite.datasets.open import open_source
from gausslite.datasets.source import Source
from gausslite.domain.errors import InvalidInputError
from gausslite.domain.frame import Frame
from gausslite.domain.pose import inverse, rotation_angle_deg, transform_of, translation_m
from gausslite.domain.recording import PoseExposurePrior
from gausslite.mapping.mapper import FrameView, GaussianMapper
from gausslite.mission.build import build_mapper
from gausslite.mission.localisation_monitor import Admission, LocalisationState
from gausslite.mission.settings import MissionSettings
from gausslite.mission.task_mapper import TaskMapper
from gausslite.perception.relevance import NoTaskEstimator
from gausslite.render.choose import choose_rasterizer
from gausslite_bench.cli.study_options import names_among
from gausslite_bench.quality.real_scenes import REAL_CAMERA
from gausslite_bench.report import Report
from gausslite_evaluation.compare import evaluate
from gausslite_evaluation.views import HeldOutView
from gausslite_relocalisation.monitor import FrameMonitor

_WRONG_M, _WRONG_DEG = 0.3, 10.0
"""A frame that is mapped farther from its true pose is wrong."""
_COVERED_NS = 10_000_000_000
_T_BEGUN = transform_of(np.array([4.0, -3.0, 0.2, 0.0, 0.0, 2.0]))
_NOISE = 2.0
"""Standard deviation of the colours of frames that are shown again, of 255."""
_VIEWS = 12
_NEAR_M = 1.0
"""A robot that turns where it stands: frames of the recording are this close to it."""

Frames = Sequence[Frame]
Poses = Float64[ndarray, "4 4"]


def _standing(before: Frame, after: Frames) -> Poses:
    """Return T_odometry_world of an odometry that did not follow the robot from one frame to the others."""
    T_odometry_world: Poses = before.T_world_camera @ inverse(after[0].T_world_camera)
    return T_odometry_world


@dataclass(frozen=True, slots=True)
class _Event:
    """The odometry after it, and which frames follow, by their name in `_Recording.after`."""

    follow: str
    T_odometry_world: Callable[[Frame, Frames], Poses]
    late_ns: int = 0


EVENTS = {
    "none": _Event("way", lambda _before, _after: np.eye(4)),
    "seen": _Event("seen", _standing),
    "turned": _Event("turned", _standing),
    "unseen": _Event("elsewhere", _standing),
    "look-alike": _Event("mirrored", _standing),
    "ahead": _Event("back", _standing),
    "covered": _Event("seen", _standing, _COVERED_NS),
    "restart": _Event("way", lambda _before, after: inverse(after[0].T_world_camera)),
    "jump": _Event("way", lambda _before, _after: _T_BEGUN),
}
"""none; carried to a place that was seen before, to another recording, to a mirrored place, or ahead, from where the
robot drives back to what it has seen; turned where it stands; covered for ten seconds and carried; odometry
that begins at zero, or jumps, while the robot drives on."""


@dataclass(frozen=True, slots=True)
class KidnapSettings:
    """The options of `bench kidnaps`."""

    source: str = option("sim:home", "the recording", metavar="ADDRESS")
    elsewhere: str = option("sim:home-2", "another one, of a place that the map does not have", metavar="ADDRESS")
    events: tuple[str, ...] = option(
        tuple(EVENTS), f"among {', '.join(EVENTS)}", metavar="A,B", convert=names_among(EVENTS)
    )
    frames: int = option(48, "frames before the event", low=12)
    after: int = option(16, "frames after it", low=4)
    stride: int = option(1, "every n-th frame of the recording", low=1)
    width: int = option(160, "of the images, in pixels", low=64)
    iterations: int = option(8, "of training for each frame", low=0)


class _TimedMonitor(FrameMonitor):
    """A monitor that adds up its time, and keeps what it has found."""

    def __init__(self) -> None:
        super().__init__()
        self.seconds = 0.0
        self.found: list[tuple[Frame, Poses]] = []

    def admit(self, frame: Frame, mapper: GaussianMapper) -> Admission:
        """Return which frames are mapped now."""
        start_s = time.perf_counter()
        admission = super().admit(frame, mapper)
        self.seconds += time.perf_counter() - start_s
        T_map_odometry = admission.T_map_odometry
        if admission.joined is not None:
            T_map_odometry = admission.joined["T_corrected_odometry"]
        if T_map_odometry is not None:
            self.found.append((frame, T_map_odometry))
        return admission

    def confirm(self, frame: Frame, view: FrameView) -> bool:
        """Return False if a frame contradicts the map."""
        start_s = time.perf_counter()
        is_confirmed = super().confirm(frame, view)
        self.seconds += time.perf_counter() - start_s
        return is_confirmed


@dataclass(frozen=True, slots=True, eq=False)
class _Recording:
    """The frames of both places, with times that go on."""

    source: Source
    elsewhere: Source
    settings: KidnapSettings

    def __post_init__(self) -> None:
        settings = self.settings
        for source, first in ((self.source, settings.frames), (self.elsewhere, 0)):
            if (needed := (first + settings.after) * settings.stride) > len(source):
                raise InvalidInputError(
                    f"{source.name}: expected at least {needed} frames, got {len(source)}; "
                    "use fewer --frames, --after or a smaller --stride"
                )

    def before(self) -> Frames:
        """Return the frames before each event."""
        return self._frames(self.source, range(self.settings.frames), 0)

    def after(self, follow: str) -> Frames:
        """Return the frames that follow, those of a place that was seen with other noise."""
        count, after = self.settings.frames, self.settings.after
        if follow == "way":
            return self._frames(self.source, range(count, count + after), count)
        positions = {
            "seen": range(count // 4, count // 4 + after),
            "mirrored": range(count // 4, count // 4 + after),
            "elsewhere": range(after),
            "back": range(count + after - 1, max(count - after, 0) - 1, -1),
        }
        chosen = positions[follow] if follow in positions else self._turned()
        rng = np.random.default_rng(0)
        noisy = [
            replace(frame, rgb=np.clip(frame.rgb + rng.normal(0, _NOISE, frame.rgb.shape), 0, 255).astype(np.uint8))
            for frame in self._frames(self.elsewhere if follow == "elsewhere" else self.source, chosen, count)
        ]
        return list(map(_mirrored, noisy)) if follow == "mirrored" else noisy

    def _turned(self) -> range:
        """Return the frames from the one on that looks away the most, near where the robot stands before the event."""
        poses = self.source.trajectory().T_world_camera[:: self.settings.stride]
        last = poses[self.settings.frames - 1]
        starts = range(len(poses) - self.settings.after + 1)
        near = [i for i in starts if translation_m(poses[i], last) < _NEAR_M]
        start = max(near, key=lambda i: rotation_angle_deg(poses[i], last))
        return range(start, start + self.settings.after)

    def _frames(self, source: Source, positions: range, index: int) -> Frames:
        stride, camera = self.settings.stride, source.camera.narrower(self.settings.width)
        size = camera.width_px, camera.height_px
        step_ns = round(1e9 * stride * float(np.median(np.diff(self.source.trajectory().times_s))))
        frames = (source.frame(position * stride, size) for position in positions)
        return [replace(frame, index=i, capture_time_ns=i * step_ns) for i, frame in enumerate(frames, index)]


def _mirrored(frame: Frame) -> Frame:
    """Return what the camera would record if left and right of the world changed places."""
    mirror = np.diag([-1.0, 1.0, 1.0, 1.0])
    return replace(
        frame,
        rgb=np.ascontiguousarray(frame.rgb[:, ::-1]),
        depth_m=np.ascontiguousarray(frame.depth_m[:, ::-1]),
        camera=frame.camera.mirrored(),
        T_world_camera=mirror @ frame.T_world_camera @ mirror,
    )


def _is_wrong(T: Poses, T_true: Poses) -> bool:
    return translation_m(T, T_true) > _WRONG_M or rotation_angle_deg(T, T_true) > _WRONG_DEG


def _after_event(
    mission: TaskMapper, odometry: Frames, true: Frames | None, monitor: _TimedMonitor | None
) -> dict[str, Any]:
    """Map the frames after an event; return when it was noticed, when the robot was found, and what is wrong.

    true: the frames at their own poses; None of a place that the map does not have.
    """
    noticed = found = None
    wrong_gaussians, gaussians = 0, len(mission.gaussians())
    for i, frame in enumerate(odometry):
        outcome, correction = mission.process(frame), mission.poses.latest()
        is_noticed = outcome.localisation is not LocalisationState.TRACKED or (monitor is not None and monitor.found)
        noticed = i if is_noticed and noticed is None else noticed
        if outcome.skipped is None and correction is not None:
            T_world_camera = correction.T_map_odometry @ frame.T_world_camera
            is_wrong = true is None or _is_wrong(T_world_camera, true[i].T_world_camera)
            wrong_gaussians += max(outcome.gaussians - gaussians, 0) * is_wrong
            found = i if found is None and not is_wrong else found
        gaussians = outcome.gaussians
    poses = mission.poses.state()
    in_map = dict(zip(poses["frames"][:, 0].tolist(), poses["T_world_map"], strict=True))
    mapped = [i for i, frame in enumerate(odometry) if frame.index in in_map]
    wrong = sum(true is None or _is_wrong(in_map[odometry[i].index], true[i].T_world_camera) for i in mapped)
    return {"noticed": noticed, "found": found, "mapped": len(mapped), "wrong": wrong, "wrong_gs": wrong_gaussians}


class _Trials:
    """The missions of a recording; those of the same frames at their own poses are mapped once."""

    def __init__(self, recording: _Recording) -> None:
        self._recording, self._before = recording, recording.before()
        self._prior = PoseExposurePrior() if recording.source.poses_exact else REAL_CAMERA
        self._references: dict[str, float] = {}

    def run(self, name: str, is_watched: bool) -> dict[str, Any]:
        """Return the figures of an event."""
        event = EVENTS[name]
        after, is_known = self._recording.after(event.follow), event.follow not in ("elsewhere", "mirrored")
        monitor = _TimedMonitor() if is_watched else None
        mission = self._mission(monitor)
        outcomes = [mission.process(frame) for frame in self._before]
        watching = 0.0 if monitor is None else monitor.seconds / sum(outcome.timing.seconds for outcome in outcomes)
        figures = _after_event(mission, self._odometry(event, after), after if is_known else None, monitor)
        true = {frame.index: frame.T_world_camera for frame in after}
        return {
            "event": name,
            "watched": is_watched,
            "false_alarms": sum(outcome.localisation is not LocalisationState.TRACKED for outcome in outcomes),
            **figures,
            "false_places": sum(
                not is_known or _is_wrong(T @ frame.T_world_camera, true[frame.index])
                for frame, T in ([] if monitor is None else monitor.found)
                if frame.index in true
            ),
            "psnr": self._psnr(mission),
            "psnr_without_event": self._reference(event.follow, after if is_known else ()),
            "watching_share": watching,
        }

    def _odometry(self, event: _Event, after: Frames) -> Frames:
        T_odometry_world = event.T_odometry_world(self._before[-1], after)
        return [
            replace(
                frame,
                T_world_camera=T_odometry_world @ frame.T_world_camera,
                capture_time_ns=frame.capture_time_ns + event.late_ns,
            )
            for frame in after
        ]

    def _mission(self, monitor: FrameMonitor | None = None) -> TaskMapper:
        iterations = self._recording.settings.iterations
        settings = MissionSettings(policy="uniform", iterations=iterations, pose_prior=self._prior)
        return TaskMapper(NoTaskEstimator(), build_mapper(settings), monitor=monitor)

    def _reference(self, follow: str, after: Frames) -> float:
        if follow not in self._references:
            mission = self._mission()
            for frame in (*self._before, *after):
                mission.process(frame)
            self._references[follow] = self._psnr(mission)
        return self._references[follow]

    def _psnr(self, mission: TaskMapper) -> float:
        """Return the PSNR of frames before the event."""
        shown = self._before[:: max(len(self._before) // _VIEWS, 1)]
        views = [HeldOutView(frame, np.zeros(frame.depth_m.shape, np.bool_)) for frame in shown]
        return evaluate(mission.gaussians(), views, choose_rasterizer("auto", None)).full_psnr


def run_kidnaps(settings: KidnapSettings) -> Report:
    """Run the events, watched and not; good without a false alarm, a false place and a Gaussian of a watched one wrong.

    noticed, found: number of the first frame after the event that is not mapped as before, and that is mapped right.
    wrong: frames that are mapped at a wrong pose, wrong_gs: Gaussians that these add. psnr: of the frames before it.
    """
    trials = _Trials(_Recording(open_source(settings.source), open_source(settings.elsewhere), settings))
    rows = []
    with progress_bar(2 * len(settings.events), "kidnaps", "mission") as progress:
        for name in settings.events:
            for is_watched in (True, False):
                rows.append(trials.run(name, is_watched))
                progress.update()
    faults = ("false_alarms", "false_places")
    return Report({"events": rows}, is_good=not any(row[fault] for row in rows for fault in faults))
