"""Carry, cover and restart a robot in a recording: is it noticed, is it found, and what does the map keep of it?

Each event begins after the same frames. Its map is compared with that of the same frames at their own poses.
"""

from __future__ import annotations

import time
from typing import Any

from gausslite.cli.progress import progress_bar
from gausslite.datasets.calibration import StatedValues, open_calibrator
from gausslite.datasets.open import open_source
from gausslite.datasets.regions import choose_regions
from gausslite.datasets.source import Source
from gausslite.domain.frame import Frame
from gausslite.domain.pose import rotation_angle_deg, translation_m
from gausslite.domain.recording import CameraCorrection, PoseExposurePrior
from gausslite.mapping.mapper import FrameView, GaussianMapper
from gausslite.mission.build import build_mapper, region_estimator
from gausslite.mission.localisation_monitor import Admission, LocalisationState
from gausslite.mission.task_mapper import TaskMapper
from gausslite.render.choose import choose_rasterizer
from gausslite_bench.kidnap_events import EVENTS, Event, Frames, KidnapSettings, Poses, Recording
from gausslite_bench.report import Report
from gausslite_bench.team.kidnapped import TeamTrials
from gausslite_evaluation.compare import evaluate
from gausslite_evaluation.views import HeldOutView
from gausslite_relocalisation.monitor import FrameMonitor

_WRONG_M, _WRONG_DEG = 0.3, 10.0
"""A frame that is mapped farther from its true pose is wrong."""
_VIEWS = 12


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

    def __init__(self, recording: Recording, before: Frames) -> None:
        self._recording, self._before = recording, before
        objects = recording.settings.objects
        self._regions = choose_regions(recording.source.regions(), objects) if objects else []
        self._references: dict[str, dict[str, float | None]] = {}

    def run(self, name: str, is_watched: bool) -> dict[str, Any]:
        """Return the figures of an event."""
        event = EVENTS[name]
        after, is_known = self._recording.after(event.follow), event.is_known
        monitor = _TimedMonitor() if is_watched else None
        mission = self._mission(monitor)
        outcomes = [mission.process(frame) for frame in self._before]
        watching = 0.0 if monitor is None else monitor.seconds / sum(outcome.timing.seconds for outcome in outcomes)
        figures = _after_event(mission, event.odometry(self._before[-1], after), after if is_known else None, monitor)
        true = {frame.index: frame.T_world_camera for frame in after}
        return {
            "event": name,
            "watched": is_watched,
            "false_alarms": sum(outcome.localisation is not LocalisationState.TRACKED for outcome in outcomes)
            + (name == "none" and figures["noticed"] is not None),
            **figures,
            "false_places": sum(
                not is_known or _is_wrong(T @ frame.T_world_camera, true[frame.index])
                for frame, T in ([] if monitor is None else monitor.found)
                if frame.index in true
            ),
            **self._psnr(mission),
            **{f"{name}_without_event": value for name, value in self._reference(event, after).items()},
            "watching_share": watching,
        }

    def _mission(self, monitor: FrameMonitor | None = None) -> TaskMapper:
        mapper = build_mapper(self._recording.mission_settings(bool(self._regions)))
        return TaskMapper(region_estimator(self._regions), mapper, monitor=monitor)

    def _reference(self, event: Event, after: Frames) -> dict[str, float | None]:
        follow = event.follow if event.is_known else ""
        if follow not in self._references:
            mission = self._mission()
            for frame in (*self._before, *(after if follow else ())):
                mission.process(frame)
            self._references[follow] = self._psnr(mission)
        return self._references[follow]

    def _psnr(self, mission: TaskMapper) -> dict[str, float | None]:
        """Return the PSNR of frames before the event, also of the region if there is one."""
        shown = self._before[:: max(len(self._before) // _VIEWS, 1)]
        views = [HeldOutView.of(frame, self._regions) for frame in shown]
        scores = evaluate(mission.gaussians(), views, choose_rasterizer("auto", None))
        return {"psnr": scores.full_psnr} | ({"region_psnr": scores.roi_psnr} if self._regions else {})


def _open(address: str) -> Source:
    """Return a recording, its depth registered to its colours as for a mission; nothing else is estimated."""
    stated = StatedValues(correction=CameraCorrection(), pose_prior=PoseExposurePrior())
    return open_calibrator().calibrate(open_source(address), stated).source


def run_kidnaps(settings: KidnapSettings) -> Report:
    """Run the events, watched and not; good without a false alarm, a false place and a Gaussian of a watched one wrong.

    noticed, found: number of the first frame after the event that is not mapped as before, and that is mapped right.
    wrong: frames that are mapped at a wrong pose, wrong_gs: Gaussians that these add. psnr: of the frames before it.
    """
    recording = Recording(_open(settings.source), _open(settings.elsewhere), settings)
    before = recording.before()
    trials, team = _Trials(recording, before), TeamTrials(recording, before) if settings.robots > 1 else None
    rows, of_team = [], []
    with progress_bar(2 * len(settings.events), "kidnaps", "mission") as progress:
        for name in settings.events:
            for is_watched in (True, False):
                rows.append(trials.run(name, is_watched))
                if team is not None:
                    of_team.append(team.run(name, is_watched))
                progress.update()
    faults = ("false_alarms", "false_places")
    quarantined = any(row["watched"] and row["quarantined"] for row in of_team)
    is_good = not quarantined and not any(row[fault] for row in rows for fault in faults)
    return Report({"events": rows} | ({"team": of_team} if of_team else {}), is_good)
