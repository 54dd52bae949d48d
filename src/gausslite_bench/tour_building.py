"""A building of simulated homes with corridors between them, and the way of a robot there and back, many times."""

from __future__ import annotations

import multiprocessing
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import accumulate
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64
from numpy import ndarray

from gausslite.cli.progress import progress_bar
from gausslite.datasets.open import open_source
from gausslite.domain.camera import Camera
from gausslite.domain.frame import Frame
from gausslite.domain.pose import inverse, transform_of
from gausslite_sim.odometry_drift import drifting_poses

_HOME_COUNT, _HOME_M, _NEXT_M = 8, 10.0, 8.0
"""Different homes; the next ones are the same with other objects and textures. Each is less than 7 m wide."""
_HELD_OUT, _VIEWS, CORRIDOR_FRAMES = 2, 16, 12
_CORRIDOR_M, _EYE_M, _STEP_M, _TILE_M = (8.0, 2.0, 2.5), (0.5, 1.0, 1.4), 0.5, 0.25
_BELOW_M = 8.0
"""The corridors are below the homes, so that no camera sees through the walls of both."""
_FOCAL_PER_WIDTH = 0.85
_INTERVAL_NS, _STAIRS_NS, _OFF_NS = 500_000_000, 4_000_000_000, 60_000_000_000
"""No frame comes between a corridor and a home, nor while a robot is carried or restarts."""
CARRIED_PAST = 2
"""Homes on its way that a robot misses which is carried."""
_NOISE = 2.0
"""Standard deviation of the colours of frames that are shown again, of 255."""


def _home_frames(home: int, trajectory: int, frames: int, width: int) -> list[Frame]:
    size = f"{width}x{width * 3 // 4}"
    address = f"sim:home-{1 + home % _HOME_COUNT}?seed={home // _HOME_COUNT}&trajectory={trajectory}"
    source = open_source(f"{address}&frames={frames}&size={size}")
    T_world_home = transform_of(np.array([home * _HOME_M, 0, 0, 0, 0, 0]))
    recorded = map(source.frame, range(frames))
    return [replace(frame, T_world_camera=T_world_home @ frame.T_world_camera) for frame in recorded]


def corridor_frames(home: int, width: int) -> list[Frame]:
    """Return what a camera sees that looks along the corridor behind a home, a box with coloured tiles."""
    camera = Camera.centred(_FOCAL_PER_WIDTH * width, width, width * 3 // 4)
    rows, columns = np.indices((camera.height_px, camera.width_px)) + 0.5
    right, down = camera.slopes(columns, rows)
    rays, size_m = np.stack([np.ones_like(right), -right, -down], axis=-1), np.array(_CORRIDOR_M)
    tiles = np.random.default_rng(home).integers(30, 226, (*(size_m / _TILE_M).astype(int) + 1, 3), np.uint8)
    frames = []
    for i in range(CORRIDOR_FRAMES):
        x_m, y_m, z_m = eye_m = np.add(_EYE_M, (i * _STEP_M, 0, 0))
        depth_m = ((np.where(rays > 0, size_m, 0) - eye_m) / rays).min(axis=-1)
        # walls lie in the middle of a tile's thickness
        at = np.floor((eye_m + depth_m[..., None] * rays) / _TILE_M + 0.5).astype(np.int64)
        x_m += home * _HOME_M + 1.0
        T = np.array([[0, 0, 1, x_m], [-1, 0, 0, y_m], [0, -1, 0, z_m - _BELOW_M], [0, 0, 0, 1]])
        frames.append(Frame(i, 0, tiles[tuple(np.moveaxis(at, -1, 0))], depth_m.astype(np.float32), camera, T))
    return frames


def in_first_home(points_m: Float32[ndarray, "n 3"]) -> Bool[ndarray, " n"]:
    """Return which points are nearer to the first home than to the next one and to the corridors."""
    inside: Bool[ndarray, " n"] = (points_m[:, 0] < _NEXT_M) & (points_m[:, 2] > -_BELOW_M / 3)
    return inside


def record(path: str, home: int, width: int, frames: int, trajectory: int = 0) -> None:
    """Write frames of a home, or of the corridor behind it for 0, in a process whose memory is not measured."""
    recorded = _home_frames(home, trajectory, frames, width) if frames else corridor_frames(home, width)
    names = "rgb", "depth_m", "T_world_camera"
    rgb, depth_m, poses = (np.stack([getattr(frame, name) for frame in recorded]) for name in names)
    np.savez(path, rgb=rgb, depth_m=depth_m, T_world_camera=poses, focal_px=recorded[0].camera.fx_px)


@dataclass(frozen=True, slots=True)
class Visit:
    """A home on the way, with the corridor to it unless the robot is carried there or begins in it."""

    number: int
    home: int
    is_back: bool = False
    is_carried: bool = False

    @property
    def recordings(self) -> tuple[str, ...]:
        """The names of what the robot sees, in its order."""
        corridor = () if self.is_carried or self.number == 0 else (f"corridor-{self.home - (not self.is_back)}",)
        return (*corridor, f"home-{self.home}")


def planned_visits(homes: int, laps: int, kidnaps: tuple[int, ...]) -> list[Visit]:
    """Return the homes from the first to the last and back, without those that a kidnapped robot is carried past."""
    way = [*(*range(homes), *range(homes - 2, 0, -1)) * laps, 0]
    missed = {number + past for number in kidnaps for past in range(1, CARRIED_PAST + 1)}
    return [
        Visit(number, home, number > 0 and home < way[number - 1], number - 1 in missed)
        for number, home in enumerate(way)
        if number not in missed
    ]


@dataclass(frozen=True)
class Building:
    """The recordings, in files, of all that a robot sees on its visits. drift: of its odometry, a share."""

    folder: Path
    visits: list[Visit]
    restarts: tuple[int, ...]
    drift: float

    def record(self, width: int, frames: int) -> None:
        """Record homes and corridors, and the held-out views of the first home."""
        last = max(visit.home for visit in self.visits)
        jobs = [("views", 0, width, _VIEWS, _HELD_OUT)]
        jobs += [(f"home-{home}", home, width, frames, 0) for home in range(last + 1)]
        jobs += [(f"corridor-{home}", home, width, 0, 0) for home in range(last)]
        context = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(1, mp_context=context) as pool, progress_bar(len(jobs), "record", "place") as bar:
            for name, *arguments in jobs:
                pool.submit(record, str(self.folder / f"{name}.npz"), *arguments).result()
                bar.update()

    def views(self) -> list[Frame]:
        """Return the held-out views of the first home, at their true poses."""
        return list(self._recorded("views"))

    def frames(self, visit: Visit) -> Iterator[tuple[str, Frame]]:
        """Yield the frames of a visit with new noise, as the odometry places them, and the name of what they show."""
        index = self._first[visit.number]
        for name in visit.recordings:
            for frame in self._recorded(name)[:: -1 if visit.is_back else 1]:
                noise = np.random.default_rng(index).normal(0, _NOISE, frame.rgb.shape)
                rgb = np.clip(frame.rgb + noise, 0, 255).astype(np.uint8)
                T, time_ns = self.odometry_poses[index], int(self._times_ns[index])
                yield name, replace(frame, index=index, capture_time_ns=time_ns, rgb=rgb, T_world_camera=T)
                index += 1

    @cached_property
    def true_poses(self) -> Float64[ndarray, "n 4 4"]:
        """The true poses of all frames."""
        names = [(name, -1 if visit.is_back else 1) for visit in self.visits for name in visit.recordings]
        return np.concatenate([self._poses(name)[::step] for name, step in names])

    @cached_property
    def odometry_poses(self) -> Float64[ndarray, "n 4 4"]:
        """The poses by the odometry: it stands while the robot is carried, and begins at zero when it restarts."""
        true, carried = self.true_poses, {self._first[visit.number] for visit in self.visits if visit.is_carried}
        steps = (np.eye(4) if i in carried else inverse(true[i - 1]) @ true[i] for i in range(1, len(true)))
        driven = np.stack(list(accumulate(steps, np.matmul, initial=true[0])))
        poses = drifting_poses(driven, self.drift, np.random.default_rng(0))
        for first in map(self._first.__getitem__, self.restarts):
            poses[first:] = inverse(poses[first]) @ poses[first:]
        return poses

    @cached_property
    def _first(self) -> dict[int, int]:
        """The number of each visit's first frame."""
        lengths = [sum(len(self._poses(name)) for name in visit.recordings) for visit in self.visits]
        starts = accumulate(lengths[:-1], initial=0)
        return {visit.number: start for visit, start in zip(self.visits, starts, strict=True)}

    @cached_property
    def _times_ns(self) -> Int64[ndarray, " n"]:
        steps_ns = np.full(len(self.true_poses), _INTERVAL_NS)
        for visit in self.visits:
            first = self._first[visit.number]
            steps_ns[first + CORRIDOR_FRAMES * (len(visit.recordings) - 1)] = _STAIRS_NS
            steps_ns[first] = _OFF_NS if visit.number in self.restarts else _STAIRS_NS
        return np.cumsum(steps_ns)

    def _poses(self, name: str) -> Float64[ndarray, "n 4 4"]:
        with np.load(self.folder / f"{name}.npz") as arrays:
            poses: Float64[ndarray, "n 4 4"] = arrays["T_world_camera"]
            return poses

    def _recorded(self, name: str) -> list[Frame]:
        with np.load(self.folder / f"{name}.npz") as arrays:
            images, focal_px = [arrays[key] for key in ("rgb", "depth_m", "T_world_camera")], float(arrays["focal_px"])
        height, width = images[1].shape[1:]
        camera = Camera.centred(focal_px, width, height)
        parts = zip(*images, strict=True)
        return [Frame(i, 0, rgb.copy(), depth_m.copy(), camera, T) for i, (rgb, depth_m, T) in enumerate(parts)]
