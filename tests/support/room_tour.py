"""Rooms of one slanted wall each, far apart, and a robot that goes through them and comes back to the first one."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from gausslite.domain.camera import Camera
from gausslite.domain.frame import Frame
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.relevance import BallRegion
from gausslite.domain.voxels import VoxelGrid
from gausslite.mapping.mapper import GaussianMapper
from gausslite.mapping.pager import MapPager
from gausslite.mapping.pose_corrector import PoseCorrector
from gausslite.mapping.settings import (
    DensitySettings,
    KeyframeSettings,
    MapperSettings,
    OptimizationSettings,
    SeedingSettings,
)
from gausslite.mapping.voxel_exchange import SentVoxelTracker
from gausslite.mission.task_mapper import TaskMapper
from gausslite.perception.relevance import RegionRelevanceEstimator
from gausslite.render.cpu import CpuRasterizer
from gausslite_paging.pager import DiskPager

GRID = VoxelGrid()
ROOM_M = 30.0
FRAMES = 6
"""Frames in each room."""
TOUR = (0, 1, 2, 3, 4, 0)
"""The rooms in their order."""
CAP, DISK_BYTES = 3600, 40_000_000
_WIDTH, _HEIGHT, _SLANT = 48, 32, 0.21


def room_frame(index: int) -> Frame:
    """The frame of this number of the tour; no two points have one depth."""
    room, step = TOUR[index // FRAMES], index % FRAMES
    camera = Camera(float(_WIDTH), float(_WIDTH), _WIDTH / 2, _HEIGHT / 2, _WIDTH, _HEIGHT)
    u, v = np.meshgrid((np.arange(_WIDTH) + 0.5 - camera.cx_px) / _WIDTH, (np.arange(_HEIGHT) - 15.5) / _WIDTH)
    x_m = 0.05 * step
    depth_m = (2.0 + _SLANT * x_m) / (1.0 - _SLANT * u - 0.13 * v)
    across, down = x_m + u * depth_m, v * depth_m
    pattern = 0.5 + 0.25 * np.sin(6 * across + room) + 0.25 * np.cos(5 * down)
    rgb = (255 * np.stack([pattern, pattern**2, 1 - pattern], axis=-1)).astype(np.uint8)
    T_world_camera = np.eye(4)
    T_world_camera[0, 3] = room * ROOM_M + x_m
    return Frame(index, index * 500_000_000, rgb, depth_m.astype(np.float32), camera, T_world_camera)


def tour_frames(first: int = 0, end: int = len(TOUR) * FRAMES) -> Iterator[Frame]:
    """The frames of the tour."""
    return map(room_frame, range(first, end))


def rooms_mapper(
    pager: MapPager | None, corrector: PoseCorrector | None = None, cap: int = CAP, ema_updates: float = 32.0
) -> GaussianMapper:
    """A mapper whose results do not depend on the number of Gaussians in memory while this is below its limit."""
    settings = MapperSettings(
        max_gaussians=cap,
        seeding=SeedingSettings(background_share=0.0),
        keyframes=KeyframeSettings(every=2, window=2, buffer=4, long_term_keyframes=0),
        optimization=OptimizationSettings(ema_updates=ema_updates),
        density=DensitySettings(densify_every=61, prune_every=9, max_growth=1.0),
    )
    return GaussianMapper(settings, CpuRasterizer(threads=1), seed=3, corrector=corrector, pager=pager)


def disk_pager(mapper_cap: int = CAP, max_bytes: int = DISK_BYTES) -> DiskPager:
    """A pager of such a mapper."""
    return DiskPager(rooms_mapper(None, cap=mapper_cap).settings, GRID, max_bytes)


def rooms_mission(mapper: GaussianMapper) -> TaskMapper:
    """A mission for a ball in the middle of each wall."""
    balls = [BallRegion((room * ROOM_M, 0.0, 2.0), 0.4) for room in sorted(set(TOUR))]
    return TaskMapper(RegionRelevanceEstimator(balls), mapper, SentVoxelTracker(GRID))


def sorted_bytes(gaussians: Gaussians) -> list[bytes]:
    """Return each Gaussian's bytes in an order that does not depend on the rows."""
    columns = [np.ascontiguousarray(getattr(gaussians, name)) for name in Gaussians.__dataclass_fields__]
    return sorted(b"".join(column[i].tobytes() for column in columns) for i in range(len(gaussians)))
