"""Free space: observed from depth, encoded at a few bits a voxel, and stored for each agent."""

from __future__ import annotations

import struct
from dataclasses import replace
from pathlib import Path

import cv2
import google_crc32c
import numpy as np
import pytest
from sample_gaussians import plain_gaussians

from gausslite.codec.stored import decode_free_space, encode_free_space
from gausslite.domain.camera import Camera
from gausslite.domain.errors import GaussLiteError, MismatchError
from gausslite.domain.frame import Frame
from gausslite.domain.free_space import FreeSpace
from gausslite.domain.voxels import RoiSubset, VoxelGrid, group_by_voxel
from gausslite.fusion.engine import FusionEngine
from gausslite.fusion.limits import FusionSettings
from gausslite.fusion.sqlite_store import SqliteStore
from gausslite.fusion.store import MissionConfig
from gausslite.mapping.free_space import FreeSpaceMap

GRID = VoxelGrid(0.10)
CAMERA = Camera(60.0, 60.0, 32.0, 24.0, 64, 48)


def wall(depth_m: float, index: int = 0) -> Frame:
    """A view from the origin along z of a wall."""
    depth = np.full((48, 64), depth_m, np.float32)
    return Frame(index, index, np.full((48, 64, 3), 90, np.uint8), depth, CAMERA, np.eye(4))


def observed(views: int, depth_m: float = 2.0) -> FreeSpace:
    free = FreeSpaceMap(GRID)
    for index in range(views):
        free.observe(wall(depth_m, index))
    return free.free_space


def key_at(x: float, y: float, z: float) -> np.ndarray:
    return GRID.keys(np.array([[x, y, z]], np.float32))


def test_voxels_between_the_camera_and_the_wall_are_free() -> None:
    free = observed(2)
    assert free.views(key_at(0.05, 0.05, 1.05), GRID).tolist() == [2]
    for x, z in ((0.05, 1.95), (0.05, 2.55), (1.5, 1.05), (0.05, -1.0)):
        assert free.views(key_at(x, 0.05, z), GRID).tolist() == [0]
    assert free.free_voxels > 50


def test_counts_saturate_and_pixels_without_depth_show_nothing() -> None:
    assert observed(9).counts.max() == 3
    free = FreeSpaceMap(GRID)
    holes = wall(2.0)
    holes.depth_m[20:28, 28:36] = 0.0
    free.observe(holes)
    assert free.free_space.views(key_at(0.05, 0.05, 1.05), GRID).tolist() == [0]


def test_a_thin_post_is_never_free() -> None:
    free = FreeSpaceMap(GRID)
    frame = wall(2.0)
    frame.depth_m[:, 35] = 1.0
    free.observe(frame)
    x_m = (35.5 - CAMERA.cx_px) / CAMERA.fx_px
    assert free.free_space.views(key_at(x_m, 0.05, 1.05), GRID).tolist() == [0]
    assert free.free_space.views(key_at(-0.35, 0.05, 1.05), GRID).tolist() == [1]


@pytest.mark.parametrize("voxel_m", [0.02, 0.05])
def test_an_oblique_view_of_a_large_room_shows_free_space(voxel_m: float) -> None:
    camera = Camera(272.0, 272.0, 160.0, 120.0, 320, 240)
    T_world_camera = np.eye(4)
    T_world_camera[:3, :3] = cv2.Rodrigues(np.array([0.4, 0.7, 0.2]))[0]
    rgb, depth_m = np.zeros((240, 320, 3), np.uint8), np.full((240, 320), 6.0, np.float32)
    free = FreeSpaceMap(VoxelGrid(voxel_m))
    free.observe(Frame(0, 0, rgb, depth_m, camera, T_world_camera))
    ahead = (T_world_camera @ np.array([0.0, 0.0, 1.0, 1.0]))[:3]
    keys = VoxelGrid(voxel_m).keys(ahead[None].astype(np.float32))
    assert free.free_space.views(keys, VoxelGrid(voxel_m)).tolist() == [1]


def test_only_changed_blocks_are_collected() -> None:
    free = FreeSpaceMap(GRID)
    free.observe(wall(2.0))
    assert len(free.collect_changes().keys) == len(free.free_space.keys) > 0
    assert len(free.collect_changes().keys) == 0


def test_the_codec_needs_a_few_bits_a_voxel_and_loses_nothing() -> None:
    free = observed(2)
    data = encode_free_space(free, GRID)
    decoded, grid = decode_free_space(data)
    assert grid == GRID
    assert np.array_equal(decoded.keys, free.keys)
    assert np.array_equal(decoded.counts, free.counts)
    assert 8 * len(data) / free.free_voxels < 8


def test_hostile_messages_are_one_error() -> None:
    data = encode_free_space(observed(2), GRID)

    def resealed(message: bytes) -> bytes:
        return message[:-4] + struct.pack("<I", google_crc32c.value(message[:-4]))

    rng = np.random.default_rng(0)
    hostile = [b"", data[:10], data[:-1], b"XXXX" + data[4:], data + b"\0" * (1 << 21)]
    hostile += [resealed(data[:6] + struct.pack("<I", count) + data[10:]) for count in (0, 1, 2**32 - 1)]
    for _ in range(200):
        changed = bytearray(data)
        changed[int(rng.integers(len(data)))] ^= int(rng.integers(1, 256))
        hostile += [bytes(changed)]
    for message in hostile:
        with pytest.raises(GaussLiteError):
            decode_free_space(message)
    changed = bytearray(data)
    changed[-20] ^= 255
    with pytest.raises(GaussLiteError):
        decode_free_space(resealed(bytes(changed)))


def team(store: SqliteStore) -> tuple[FusionEngine, str]:
    """An engine with a stray Gaussian of ant in front of the wall and its surface; returns bee's session."""
    engine = FusionEngine(store, FusionSettings(grid=GRID))
    ant, bee = (engine.join(name, MissionConfig("", "", 0.10)).session.session_id for name in ("ant", "bee"))
    gaussians = plain_gaussians([(0.05, 0.05, 1.05), (0.05, 0.05, 2.05)], kappa=9)
    engine.contribute(ant, RoiSubset("ant", "", 1, 1, group_by_voxel(gaussians, GRID)), GRID)
    return engine, bee


def test_the_vote_ignores_free_space(tmp_path: Path) -> None:
    store = SqliteStore(tmp_path / "a.sqlite")
    engine, bee = team(store)
    engine.contribute_free_space(bee, observed(2), GRID)
    assert len(engine.maps.voted_map()) == 2
    free_voxels = engine.status().agents[1].free_voxels
    assert free_voxels > 0
    assert FusionEngine(store, FusionSettings(grid=GRID)).status().agents[1].free_voxels == free_voxels
    with pytest.raises(MismatchError, match="voxel size"):
        engine.contribute_free_space(bee, observed(2), VoxelGrid(0.05))
    engine.leave(bee, forget=True)
    assert store.records("free_space") == {}
    store.close()


def test_free_space_of_wrong_shape_is_refused() -> None:
    free = observed(1)
    for wrong in ({"keys": free.keys[::-1].copy()}, {"counts": free.counts + np.uint8(3)}):
        with pytest.raises(GaussLiteError, match="free space"):
            replace(free, **wrong)
