"""Hours in a building of simulated homes: memory, disk, poses, and what is left of the first home.

The robot's odometry may drift, it may be carried past homes and restart, and its task may change.
"""

from __future__ import annotations

import gc
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gausslite.cli.progress import print_above_bar, progress_bar
from gausslite.config.option import option
from gausslite.domain.errors import InvalidInputError
from gausslite.domain.frame import Frame
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.pose import rotation_angle_deg, transform_points, translation_m
from gausslite.domain.recording import PoseExposurePrior
from gausslite.domain.relevance import BallRegion
from gausslite.mission.build import build_mapper, open_monitor
from gausslite.mission.checkpoint import ResumeConfig, SavedRun, save_run
from gausslite.mission.results import peak_rss_mib
from gausslite.mission.settings import DEFAULT_MAX_GAUSSIANS, MissionSettings, default_policy
from gausslite.mission.task_mapper import TaskMapper
from gausslite.perception.relevance import NoTaskEstimator, RegionRelevanceEstimator, RelevanceEstimator
from gausslite.process import return_free_memory
from gausslite.render.choose import choose_rasterizer
from gausslite.render.map_viewer import MapViewer
from gausslite_bench.quality.real_scenes import REAL_CAMERA
from gausslite_bench.report import Report
from gausslite_bench.service_process import resident_mib
from gausslite_bench.tour_building import CARRIED_PAST, Building, Visit, in_first_home, planned_visits
from gausslite_evaluation.compare import ViewScore, average, score_view
from gausslite_evaluation.views import HeldOutView, render_fitted
from gausslite_paging.pager import DiskPager

_WRONG_M, _WRONG_DEG = 0.3, 10.0
"""A frame that is mapped farther from where the map has its place is wrong."""
_TARGET_M = 1.0


@dataclass(frozen=True, slots=True)
class TourSettings:
    """The options of `bench tour`."""

    homes: int = option(8, "homes, 10 m apart", low=2, high=64)
    laps: int = option(1, "ways to the last home and back", low=1)
    frames: int = option(60, "frames in each home, at 2 Hz; a corridor has 12", low=8)
    width: int = option(160, "of the images, in pixels", low=64)
    iterations: int = option(8, "of training for each frame", low=0)
    max_gaussians: int = option(DEFAULT_MAX_GAUSSIANS, "in memory", low=1)
    disk_mb: int = option(0, "for parts of the map on disk; 0: all is in memory", low=0)
    drift: float = option(0.0, "of the odometry, of the way and of the angle turned", unit="%", low=0.0, high=20.0)
    kidnaps: tuple[int, ...] = option((), "visits after which the robot is carried past two homes", metavar="N,N")
    restarts: tuple[int, ...] = option((), "visits before which the agent is saved and restarted", metavar="N,N")
    tasks: tuple[int, ...] = option((), "visits that begin with another task", metavar="N,N")

    def __post_init__(self) -> None:
        last, come = 2 * self.laps * (self.homes - 1), {visit.number for visit in self.visits}
        for name, limit in {"kidnaps": last - CARRIED_PAST - 1, "restarts": last, "tasks": last}.items():
            for number in getattr(self, name):
                if not 0 < number <= limit or number not in come:
                    raise InvalidInputError(f"{name}: expected visits from 1 to {limit} that are made, got {number}")

    @property
    def visits(self) -> list[Visit]:
        """The visits that are made."""
        return planned_visits(self.homes, self.laps, self.kidnaps)


class _Tour:
    """One mission through the building."""

    def __init__(self, building: Building, settings: TourSettings) -> None:
        self._building, self._settings = building, settings
        self._mission_settings = MissionSettings(
            policy=default_policy(bool(settings.tasks)),
            iterations=settings.iterations,
            max_gaussians=settings.max_gaussians,
            disk_mb=settings.disk_mb,
            pose_prior=REAL_CAMERA if settings.drift else PoseExposurePrior(),
        )
        self._estimator: RelevanceEstimator = NoTaskEstimator()
        self._begin()

    def _begin(self) -> None:
        self._mapper = build_mapper(self._mission_settings)
        self.mission = TaskMapper(self._estimator, self._mapper, monitor=open_monitor(self._mission_settings))

    def _restart(self) -> None:
        path = self._building.folder / "agent.state"
        save_run(path, self.mission, ResumeConfig.of(self._mission_settings), 0)
        self._begin()
        gc.collect()  # a new process has nothing of the old mission
        SavedRun.read(path).restore(self.mission)

    def visit(self, visit: Visit) -> dict[str, Any]:
        """Map the frames of a visit; return the figures at its end."""
        seconds, waited = [], 0
        is_return = visit.home == 0 and visit.number > 0
        before = {f"{name}_before": value for name, value in self.psnr().items()} if is_return else {}
        if visit.number in self._settings.restarts:
            self._restart()
        needs_task = visit.number in self._settings.tasks
        for name, frame in self._building.frames(visit):
            start_s = time.perf_counter()
            is_mapped = self.mission.process(frame).skipped is None
            seconds.append(time.perf_counter() - start_s)
            waited += not is_mapped
            if is_mapped and needs_task and name.startswith("home"):
                self._assign(frame)
                needs_task = False
        pager = self._mapper.pager
        return {
            "visit": visit.number,
            "home": visit.home,
            "frames": len(seconds),
            "waited": waited,
            "gaussians": self._mapper.count,
            "in_memory": self._mapper.table.count,
            "rss_mib": resident_mib(),
            "disk_mb": pager.stored_bytes / 1e6 if isinstance(pager, DiskPager) else 0.0,
            "longest_s": max(seconds),
            "hz": len(seconds) / sum(seconds),
            **before,
            **({} if visit.home else self.psnr()),
        }

    def _assign(self, frame: Frame) -> None:
        """Make what the camera looks at the task, where the map has it."""
        correction = self.mission.poses.latest()
        assert correction is not None
        ahead_m = np.array([[0.0, 0.0, float(np.median(frame.depth_m))]])
        [target_m] = transform_points(correction.T_map_odometry @ frame.T_world_camera, ahead_m).tolist()
        self._estimator = RegionRelevanceEstimator([BallRegion(tuple(target_m), _TARGET_M)])
        self.mission.assign(self._estimator)

    def psnr(self) -> dict[str, float]:
        """Return the PSNR of the held-out views of the first home, at the poses that fit the map."""
        rasterizer, scores = choose_rasterizer("auto", None), {"psnr": list[ViewScore](), "psnr_alone": []}
        for view in (HeldOutView.of(frame, ()) for frame in self._building.views()):
            seen = Gaussians.concatenate(list(self.mission.parts(seen_by=view.frame)))
            for own, part in zip(scores.values(), (seen, seen.take(in_first_home(seen.means_m))), strict=True):
                own.append(score_view(render_fitted(MapViewer(part, rasterizer), view.frame), view))
        return_free_memory()
        return {name: average(own).full_psnr for name, own in scores.items()}

    def poses(self) -> dict[str, Any]:
        """Return the errors of all poses in the map, and the distances between frames of one place."""
        state, true = self.mission.poses.state(), self._building.true_poses
        indices, in_map = state["frames"][:, 0], state["T_world_map"]
        first: dict[bytes, Any] = {}
        pairs = [(first.setdefault(true[i].tobytes(), T), T) for i, T in zip(indices, in_map, strict=True)]
        away_m, away_deg = (np.array([of(*pair) for pair in pairs]) for of in (translation_m, rotation_angle_deg))
        return {
            "frames": len(true),
            "mapped": len(indices),
            "wrong": int(np.count_nonzero((away_m > _WRONG_M) | (away_deg > _WRONG_DEG))),
            "returned_m": float(np.median(away_m)),
            "ate_m": float(np.sqrt(np.square(in_map[:, :3, 3] - true[indices, :3, 3]).sum(axis=1).mean())),
        }


def run_tour(settings: TourSettings) -> Report:
    """Go through all homes and back. psnr: of held-out views of the first home, also before each return to it.

    Homes were recorded alone: no image shows what the map has behind thin walls. psnr_alone: of the home's own part.
    waited: frames that were not mapped when they came. wrong, returned_m: frames more than 0.3 m or 10 degrees from
    where the map had their place first, and the median distance. ate_m: RMS error of the positions.
    """
    with tempfile.TemporaryDirectory() as folder:
        building = Building(Path(folder), settings.visits, settings.restarts, settings.drift / 100)
        building.record(settings.width, settings.frames)
        tour, rows = _Tour(building, settings), []
        with progress_bar(len(building.visits), "tour", "home") as bar:
            for visit in building.visits:
                rows.append(tour.visit(visit))
                print_above_bar(", ".join(f"{name} {value:.4g}" for name, value in rows[-1].items()))
                bar.update()
        poses, notes = tour.poses(), list(tour.mission.notes)
    return Report({"visits": rows, "poses": poses, "notes": notes, "peak_rss_mib": peak_rss_mib()})
