"""A tour through many simulated homes side by side, and back to the first one: memory, disk, and what is left of it."""

from __future__ import annotations

import multiprocessing
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from gausslite.cli.progress import progress_bar
from gausslite.config.option import option
from gausslite.datasets.open import open_source
from gausslite.domain.camera import Camera
from gausslite.domain.frame import Frame
from gausslite.domain.pose import transform_of
from gausslite.mission.build import build_mapper
from gausslite.mission.results import peak_rss_mib
from gausslite.mission.settings import DEFAULT_MAX_GAUSSIANS, MissionSettings
from gausslite.mission.task_mapper import TaskMapper
from gausslite.perception.relevance import NoTaskEstimator
from gausslite.render.choose import choose_rasterizer
from gausslite_bench.report import Report
from gausslite_bench.service_process import resident_mib
from gausslite_evaluation.compare import evaluate
from gausslite_evaluation.views import HeldOutView

_HOME_COUNT, _HOME_M = 8, 10.0
"""Different homes; the next ones are the same with other objects and textures. Each is less than 7 m wide."""
_INTERVAL_NS = 500_000_000
_VIEWS = 16
_HELD_OUT = 2


@dataclass(frozen=True, slots=True)
class TourSettings:
    """The options of `bench tour`."""

    homes: int = option(8, "homes, 10 m apart", low=2, high=64)
    frames: int = option(60, "frames in each home, at 2 Hz", low=8)
    back: int = option(20, "frames in the first home at the end", low=1)
    width: int = option(160, "of the images, in pixels", low=64)
    iterations: int = option(8, "of training for each frame", low=0)
    max_gaussians: int = option(DEFAULT_MAX_GAUSSIANS, "in memory", low=1)
    disk_mb: int = option(0, "for parts of the map on disk; 0: all is in memory", low=0)


def _record(home: int, trajectory: int, frames: int, width: int, path: str) -> None:
    """Write the frames of a home to a file; in a process of its own, whose memory is not measured."""
    size = f"{width}x{width * 3 // 4}"
    address = f"sim:home-{1 + home % _HOME_COUNT}?seed={home // _HOME_COUNT}&trajectory={trajectory}"
    source = open_source(f"{address}&frames={frames}&size={size}")
    recorded = [source.frame(i) for i in range(frames)]
    np.savez(
        path,
        rgb=np.stack([frame.rgb for frame in recorded]),
        depth_m=np.stack([frame.depth_m for frame in recorded]),
        T_world_camera=transform_of(np.array([home * _HOME_M, 0, 0, 0, 0, 0]))
        @ np.stack([frame.T_world_camera for frame in recorded]),
        focal_px=recorded[0].camera.fx_px,
    )


@dataclass(frozen=True, slots=True)
class _Building:
    """The recordings of all homes, in files."""

    folder: Path
    settings: TourSettings

    def record(self) -> None:
        """Record all homes, and the held-out views of the first one."""
        settings, context = self.settings, multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(1, mp_context=context) as pool, progress_bar(settings.homes, "record", "home") as bar:
            pool.submit(_record, 0, _HELD_OUT, _VIEWS, settings.width, str(self.folder / "views.npz")).result()
            for home in range(settings.homes):
                path = str(self.folder / f"{home}.npz")
                pool.submit(_record, home, 0, settings.frames, settings.width, path).result()
                bar.update()

    def frames(self, name: str) -> Iterator[Frame]:
        """Yield the frames of a file."""
        with np.load(self.folder / f"{name}.npz") as arrays:
            rgb, depth_m, poses, focal_px = (arrays[key] for key in ("rgb", "depth_m", "T_world_camera", "focal_px"))
        height, width = depth_m.shape[1:]
        camera = Camera.centred(float(focal_px), width, height)
        for i in range(len(rgb)):
            yield Frame(i, 0, rgb[i].copy(), depth_m[i].copy(), camera, poses[i])


class _Tour:
    """One mission through the building."""

    def __init__(self, building: _Building) -> None:
        settings = building.settings
        mission = MissionSettings(
            policy="uniform",
            iterations=settings.iterations,
            max_gaussians=settings.max_gaussians,
            disk_mb=settings.disk_mb,
        )
        self._building, self._mapper = building, build_mapper(mission)
        self._mission = TaskMapper(NoTaskEstimator(), self._mapper)
        self._mapped = 0

    def visit(self, home: int, frames: int) -> dict[str, Any]:
        """Map the first frames of a home; return the figures at its end."""
        seconds, mapped = [], 0
        for frame in self._building.frames(str(home)):
            if frame.index == frames:
                break
            now = replace(frame, index=self._mapped, capture_time_ns=self._mapped * _INTERVAL_NS)
            start_s = time.perf_counter()
            mapped += self._mission.process(now).skipped is None
            seconds.append(time.perf_counter() - start_s)
            self._mapped += 1
        return {
            "home": home,
            "mapped": mapped,
            "gaussians": self._mapper.count,
            "in_memory": self._mapper.table.count,
            "rss_mib": resident_mib(),
            "first_s": seconds[0],
            "hz": len(seconds) / sum(seconds),
        }

    def psnr(self) -> float:
        """Return the PSNR of the held-out views of the first home."""
        views = [
            HeldOutView(frame, np.zeros(frame.depth_m.shape, np.bool_)) for frame in self._building.frames("views")
        ]
        return evaluate(self._mission.gaussians(), views, choose_rasterizer("auto", None)).full_psnr


def run_tour(settings: TourSettings) -> Report:
    """Visit all homes and return to the first one. psnr: of held-out views of the first home.

    first_s: seconds of the first frame in a home, which loads what it sees.
    """
    with tempfile.TemporaryDirectory() as folder:
        building = _Building(Path(folder), settings)
        building.record()
        tour, rows = _Tour(building), []
        with progress_bar(settings.homes + 1, "tour", "home") as bar:
            for home in range(settings.homes):
                rows.append(tour.visit(home, settings.frames))
                bar.update()
                if home == 0:
                    left = tour.psnr()
            away = tour.psnr()
            rows.append(tour.visit(0, settings.back))
            bar.update()
        psnr = {"left": left, "before_return": away, "after_return": tour.psnr()}
    return Report({"homes": rows, "psnr": psnr, "peak_rss_mib": peak_rss_mib()})
