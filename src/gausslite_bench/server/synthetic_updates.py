"""Make what many agents send of one floor that they all see, without mapping anything: voxels, objects, keyframes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from gausslite.codec.subset_codec import encode_subset
from gausslite.domain.camera import Camera
from gausslite.domain.frame import Frame
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.objects import ObjectLandmark, ObjectReport, ObjectRole
from gausslite.domain.task import TaskGraph
from gausslite.domain.voxels import AxisAlignedBox, RoiSubset, VoxelBatch, VoxelGrid, group_by_voxel, tombstones

GRID = VoxelGrid(0.10)
GAUSSIANS_PER_VOXEL = 40
DELTA_VOXELS = 30
_PATCH_COLUMNS = np.array([6, 5])
_PATCHES_IN_ROW = 64
_FILL_VOXELS = 500
PATCHES = 8
_NOISE_M, _COLOUR_NOISE = 0.001, 0.03


def voxels_batch(
    voxels: Sequence[int] | NDArray[np.int64], seed: int, per_voxel: int = GAUSSIANS_PER_VOXEL
) -> VoxelBatch:
    """Return these voxels of the floor, by number, each with so many Gaussians on its surface."""
    rng = np.random.default_rng(seed)
    patch, cell = np.divmod(np.repeat(np.asarray(voxels, np.int64), per_voxel), DELTA_VOXELS)
    corners = np.stack([patch % _PATCHES_IN_ROW, patch // _PATCHES_IN_ROW], axis=1) * _PATCH_COLUMNS
    corners += np.stack([cell % _PATCH_COLUMNS[0], cell // _PATCH_COLUMNS[0]], axis=1)
    n = len(cell)
    x, y = ((corners + rng.uniform(0.05, 0.95, (n, 2))) * GRID.size_m).T
    # bumps that are lower than a voxel fix a frame along all axes, as the furniture of a room does
    height = 0.05 + 0.035 * np.sin(9.0 * x) * np.cos(7.0 * y) + np.clip(rng.normal(0, _NOISE_M, n), -0.01, 0.01)
    luma = 0.5 + 0.3 * np.sin(4.8 * x + 1.0) * np.sin(5.7 * y)
    gaussians = Gaussians(
        means_m=np.stack([x, y, height], axis=1).astype(np.float32),
        quats_wxyz=(np.array([1.0, 0, 0, 0]) + rng.normal(0, 0.15, (n, 4))).astype(np.float32),
        scales_m=(rng.uniform(0.006, 0.02, (n, 3)) * [1, 1, 0.2]).astype(np.float32),
        opacities=rng.uniform(0.3, 0.95, n).astype(np.float32),
        rgb=(luma[:, None] + [0.05, 0, -0.05] + rng.normal(0, _COLOUR_NOISE, (n, 3))).astype(np.float32),
        active=np.ones(n, np.bool_),
        kappa=rng.integers(1, 500, n).astype(np.uint32),
        target=np.zeros(n, np.int16),
    )
    return group_by_voxel(gaussians, GRID)


def fill_messages(agent_id: str, first: int, voxels: int) -> Iterator[bytes]:
    """Yield encoded messages that fill these voxels."""
    for seq, start in enumerate(range(first, first + voxels, _FILL_VOXELS), start=1):
        batch = voxels_batch(range(start, min(start + _FILL_VOXELS, first + voxels)), seed=start)
        yield encode_subset(RoiSubset(agent_id, "", seq, seq, batch), GRID)


def delta_messages(agent_id: str, number: int, count: int, first_seq: int) -> list[bytes]:
    """Return encoded updates of the agent's area; half of it is shared with the next agent."""
    area = number * PATCHES // 2 * DELTA_VOXELS
    batches = [
        voxels_batch(range(start, start + DELTA_VOXELS), number * 100 + patch)
        for patch, start in enumerate(range(area, area + PATCHES * DELTA_VOXELS, DELTA_VOXELS))
    ]
    return [
        encode_subset(RoiSubset(agent_id, "", seq, seq, batches[seq % PATCHES]), GRID)
        for seq in range(first_seq, first_seq + count)
    ]


def tombstone_message(agent_id: str, voxels: int, update_seq: int) -> bytes:
    """Return one small message with many tombstones, far from all Gaussians."""
    batch = tombstones(np.arange(voxels, dtype=np.int64) + (1 << 40))
    return encode_subset(RoiSubset(agent_id, "", update_seq, update_seq, batch), GRID)


def object_report(graph: TaskGraph, noun: str, count: int, time_ns: int) -> ObjectReport:
    """Return a report of objects of one noun, side by side on the floor, seen until this time."""
    boxes = [AxisAlignedBox((0.5 * i, 0.0, 0.0), (0.5 * i + 0.2, 0.2, 0.2)) for i in range(count)]
    landmarks = (
        ObjectLandmark(
            f"{noun}-{i}",
            noun,
            ObjectRole.TARGET,
            (0.5 * i + 0.1, 0.1, 0.1),
            box,
            confidence=0.8,
            first_seen_ns=0,
            last_seen_ns=time_ns,
        )
        for i, box in enumerate(boxes)
    )
    return ObjectReport(graph, tuple(landmarks))


def keyframe(index: int, width_px: int = 640, height_px: int = 480) -> Frame:
    """Return a keyframe of the floor from above; a JPEG and a PNG of it take as much as those of a room."""
    rng = np.random.default_rng(index)
    rows, columns = np.mgrid[:height_px, :width_px]
    rgb = 128 + 60 * np.sin(columns / 40.0) * np.cos(rows / 30.0) + rng.normal(0, 2, (height_px, width_px))
    depth_m = 1.5 + 0.1 * np.sin(columns / 50.0) + np.round(rng.normal(0, 0.0003, rgb.shape), 3)
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[:3, 3] = 0.1 * index, 1.0, 1.5
    camera = Camera(0.8 * width_px, 0.8 * width_px, width_px / 2, height_px / 2, width_px, height_px)
    colour = np.repeat(rgb.clip(0, 255).astype(np.uint8)[..., None], 3, axis=2)
    return Frame(index, index * 250_000_000, colour, depth_m.astype(np.float32), camera, pose)
