"""A map with parts on disk is the map in memory, bit for bit: also resumed, corrected, and for a new task."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest
from room_tour import (
    CAP,
    FRAMES,
    GRID,
    ROOM_M,
    TOUR,
    disk_pager,
    room_frame,
    rooms_mapper,
    rooms_mission,
    sorted_bytes,
    tour_frames,
)
from sample_gaussians import plain_gaussians

from gausslite.codec.ply import ply_bytes
from gausslite.domain.errors import MapFileError
from gausslite.domain.frame import Frame
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.pose import transform_of
from gausslite.domain.relevance import BallRegion
from gausslite.domain.state import State
from gausslite.domain.voxels import VoxelBatch, group_by_voxel, tiles_of
from gausslite.mapping.keyframes import Keyframe
from gausslite.mapping.mapper import GaussianMapper
from gausslite.mapping.pose_corrector import LoopCounts
from gausslite.mapping.splat_table import SplatTable
from gausslite.mission.build import build_mapper
from gausslite.mission.checkpoint import ResumeConfig, SavedRun, save_run
from gausslite.mission.results import write_results
from gausslite.mission.settings import MissionSettings
from gausslite.mission.task_mapper import TaskMapper
from gausslite.perception.relevance import RegionRelevanceEstimator
from gausslite.render.map_viewer import view_map
from gausslite_paging.page_file import BLOCK_BYTES, PageFile
from gausslite_paging.pager import DiskPager, _Tiles
from gausslite_paging.visibility import Frustum

AWAY = (len(TOUR) - 1) * FRAMES
"""The first frame of the return to the first room. 3 later, splats at one depth are drawn in the order of rows."""


def changes_of(batch: VoxelBatch | None) -> tuple[bytes, bytes, bytes, list[bytes]]:
    assert batch is not None
    return batch.keys.tobytes(), batch.counts.tobytes(), batch.kappa_sums.tobytes(), sorted_bytes(batch.gaussians)


def assert_same_tour(missions: Sequence[TaskMapper], frames: Iterator[Frame], publishes: bool = True) -> list[int]:
    """Map the frames with parts on disk and all in memory; return how many Gaussians were on disk after each."""
    on_disk, (paged, whole) = [], (mission._mapper for mission in missions)
    for frame in frames:
        outcomes = [mission.process(frame) for mission in missions]
        assert outcomes[0].gaussians == outcomes[1].gaussians, frame.index
        if publishes:
            assert changes_of(outcomes[0].changed_roi) == changes_of(outcomes[1].changed_roi), frame.index
        assert sorted_bytes(paged.gaussians()) == sorted_bytes(whole.gaussians()), frame.index
        on_disk.append(paged.pager.count)
    return on_disk


def test_a_map_with_parts_on_disk_has_the_bits_of_one_in_memory() -> None:
    paged, whole = rooms_mapper(disk_pager()), rooms_mapper(None, cap=20 * CAP)
    on_disk = assert_same_tour((rooms_mission(paged), rooms_mission(whole)), tour_frames(0, AWAY + 3))
    assert on_disk[FRAMES] == 0
    # the first room left memory, and has come back for its first frame
    assert max(on_disk) > 400
    assert not paged.pager.holds(first_room_keys(whole)).any()
    assert paged.pager.count > 400
    assert paged.table.kappa.max() > 0
    active = sorted_bytes(paged.gaussians(active_only=True))
    assert active == sorted_bytes(whole.gaussians(active_only=True))


def first_room_keys(mapper: GaussianMapper) -> np.ndarray:
    means_m = mapper.table.means_m
    return GRID.keys(means_m[np.abs(means_m[:, 0]) < ROOM_M / 2])


def test_a_map_that_fits_stays_in_memory() -> None:
    paged, whole = rooms_mapper(disk_pager(20 * CAP), cap=20 * CAP), rooms_mapper(None, cap=20 * CAP)
    assert set(assert_same_tour((rooms_mission(paged), rooms_mission(whole)), tour_frames())) == {0}
    assert paged.gaussians().means_m.tobytes() == whole.gaussians().means_m.tobytes()


def map_tour(mission: TaskMapper, first: int = 0, end: int = len(TOUR) * FRAMES) -> TaskMapper:
    for frame in tour_frames(first, end):
        mission.process(frame)
    return mission


@pytest.mark.parametrize("cut", [AWAY - 1, AWAY + 1])
def test_a_resumed_run_has_the_bits_of_an_uninterrupted_one(cut: int, tmp_path: Path) -> None:
    uninterrupted = map_tour(rooms_mission(rooms_mapper(disk_pager())))
    pager = disk_pager()
    save_run(tmp_path / "run.state", map_tour(rooms_mission(rooms_mapper(pager)), 0, cut), ResumeConfig.of(), cut - 1)
    assert pager.count > 0
    resumed, saved = rooms_mission(rooms_mapper(disk_pager())), SavedRun.read(tmp_path / "run.state")
    saved.restore(resumed)
    expected, got = uninterrupted.state(), map_tour(resumed, cut).state()
    assert set(got) == set(expected)
    assert [name for name in expected if got[name].tobytes() != expected[name].tobytes()] == []


def test_a_new_task_and_its_keyframes_reach_what_is_on_disk() -> None:
    paged, whole = rooms_mapper(disk_pager()), rooms_mapper(None, cap=20 * CAP)
    missions, other = (rooms_mission(paged), rooms_mission(whole)), [BallRegion((0.4, 0.3, 2.0), 0.3)]
    for frame in tour_frames(0, AWAY + 3):
        if frame.index == AWAY - 2:
            assert paged.pager.count > 400
            for mission in missions:
                mission.assign(RegionRelevanceEstimator(other))
        batches = [mission.process(frame).changed_roi for mission in missions]
        assert changes_of(batches[0]) == changes_of(batches[1]), frame.index
        assert sorted_bytes(paged.gaussians()) == sorted_bytes(whole.gaussians()), frame.index


class _Moves:
    """Moves all keyframes at some of them, those of each room in its own way."""

    counts = LoopCounts()

    def __init__(self, at: Sequence[int]) -> None:
        self.keyframes, self._at = 0, at

    def add(self, keyframe: Keyframe, prior: Frame, kept: Sequence[Keyframe], table: SplatTable) -> np.ndarray | None:
        self.keyframes += 1
        if self.keyframes not in self._at:
            return None
        steps = np.arange(self.keyframes)[:, None] * np.array([0.01, 0.0, 0.005, 0.0, 0.001, 0.0])
        return np.array([transform_of(step) for step in steps])

    def state(self) -> State:
        return {}

    def restore(self, state: State) -> None:
        pass


@pytest.mark.parametrize("at", [[AWAY // 2 - 1], range(8, AWAY // 2)])
def test_corrections_move_what_is_on_disk_with_its_anchors(at: Sequence[int], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gausslite_paging.pager._MAX_CORRECTIONS", 2)
    paged, whole = rooms_mapper(disk_pager(), _Moves(at)), rooms_mapper(None, _Moves(at), 20 * CAP)
    missions = rooms_mission(paged), rooms_mission(whole)
    # the server learns when a tile returns that it has moved
    assert max(assert_same_tour(missions, tour_frames(0, AWAY), publishes=False)) > 400
    assert len(paged.pager._corrections) <= 2
    paged.render(room_frame(0).camera, np.eye(4))
    assert not paged.pager.holds(first_room_keys(whole)).any()
    assert sorted_bytes(paged.gaussians()) == sorted_bytes(whole.gaussians())
    sent = []
    for mission in missions:
        mission.changed_roi()
        keys = mission.state()["sent_voxels/keys"]
        sent.append(keys[np.abs(GRID.centres_m(keys)[:, 0]) < ROOM_M / 2].tolist())
    assert sent[0] == sent[1] != []


def test_the_disk_is_bounded_and_then_the_cap_holds(capsys: pytest.CaptureFixture[str]) -> None:
    bound = 16 * BLOCK_BYTES
    pager = disk_pager(max_bytes=bound)
    mapper = rooms_mapper(pager)
    mission = rooms_mission(mapper)
    for frame in tour_frames():
        mission.process(frame)
        assert pager._file.size + pager._images.size <= bound
        assert mapper.table.count <= CAP
    assert "disk-mb: the disk's share is used up" in capsys.readouterr().err
    map_tour(rooms_mission(nothing := rooms_mapper(disk_pager(max_bytes=0))))
    assert nothing.pager.count == 0


def test_a_map_is_written_and_shown_part_by_part_and_a_damaged_part_is_told(tmp_path: Path) -> None:
    pager, frame = disk_pager(), room_frame(FRAMES)
    mission = map_tour(rooms_mission(rooms_mapper(pager)), 0, AWAY)
    write_results(tmp_path, mission.count, mission.parts(), {})
    assert (tmp_path / "map.ply").read_bytes() == ply_bytes(mission.gaussians())
    seen, whole = Gaussians.concatenate(list(mission.parts(seen_by=frame))), mission.gaussians()
    assert 0 < len(seen) < len(whole)
    assert len({view_map(part, threads=1).render_frame(frame).rgb.tobytes() for part in (seen, whole)}) == 1
    os.pwrite(pager._file._fd, b"\xff" * BLOCK_BYTES, 0)
    with pytest.raises(MapFileError, match="disk-mb: expected the map's parts"):
        write_results(tmp_path, mission.count, mission.parts(), {})
    assert (tmp_path / "map.ply").read_bytes() == ply_bytes(whole)


def test_voxels_of_teammates_meet_what_is_on_disk() -> None:
    mapper = rooms_mapper(disk_pager(), ema_updates=0.0)
    mission = map_tour(rooms_mission(mapper), 0, AWAY)
    own = group_by_voxel(mapper.gaussians(), GRID)
    on_disk = mapper.pager.holds(own.keys)
    assert on_disk.any()
    before = sorted_bytes(mapper.gaussians())
    # they have no higher Σkappa, so they replace nothing
    assert mission.insert_team_voxels(own, GRID).gaussians == 0
    assert sorted_bytes(mapper.gaussians()) == before


def test_a_page_returns_as_it_was_and_its_blocks_are_used_again() -> None:
    file, size = PageFile(), 4 * BLOCK_BYTES
    data = [bytes([i]) * (2 * BLOCK_BYTES - i) for i in range(3)]
    pages = [file.write(part, size) for part in data]
    assert pages[2] is None
    assert pages[0] is not None
    assert pages[1] is not None
    file.release(pages[0])
    third = file.write(data[2], size)
    assert third is not None
    assert (file.read(third), file.read(pages[1])) == (data[2], data[1])
    with pytest.raises(MapFileError, match="damaged"):
        file.read(pages[0])


def test_a_frustum_sees_the_boxes_before_the_camera() -> None:
    frame = room_frame(0)
    low_m = np.array([[-0.5, -0.5, 2.0], [-0.5, -0.5, -3.0], [9.0, -0.5, 2.0], [-0.5, -0.5, 7.0]])
    seen = Frustum.of(frame.camera, frame.T_world_camera, 5.0).distances_m(low_m, low_m + 1.0)
    assert np.isfinite(seen).tolist() == [True, False, False, False]
    assert seen[0] == pytest.approx(2.0)


def test_tiles_are_those_of_the_voxels_and_their_boxes_follow_flat_splats() -> None:
    table, turned = SplatTable(50), (0.5**0.5, 0.0, 0.0, 0.5**0.5)
    means_m, reach_m = np.random.default_rng(0).uniform(-9, 9, (50, 3)), np.array([1.5, 0.05, 1.5])
    table.append(plain_gaussians(means_m, scales_m=(0.01, 0.3, 0.3), quats_wxyz=turned))
    tiles, of_rows = _Tiles.of(table, GRID), tiles_of(GRID.keys(table.means_m))
    assert np.sort(tiles.names).tolist() == np.unique(of_rows).tolist()
    for i, name in enumerate(tiles.names):
        assert (of_rows[tiles.rows_of(i)] == name).all()
        own_m = table.means_m[tiles.rows_of(i)]
        np.testing.assert_allclose(tiles.bounds_m[i], [own_m.min(0) - reach_m, own_m.max(0) + reach_m], atol=1e-5)


def test_the_key_opens_the_package() -> None:
    assert isinstance(build_mapper(MissionSettings(disk_mb=1, threads=1)).pager, DiskPager)
    assert not isinstance(build_mapper(MissionSettings(threads=1)).pager, DiskPager)


def test_images_of_keyframes_that_do_not_train_are_in_files_that_end_with_them() -> None:
    pager = disk_pager()
    mapper, whole = rooms_mapper(pager), rooms_mapper(None)
    missions = rooms_mission(mapper), rooms_mission(whole)
    for frame in tour_frames(0, 2 * FRAMES):
        for mission in missions:
            mission.process(frame)
    for own, other in zip(mapper.store.buffer, whole.store.buffer, strict=True):
        assert own.frame.rgb.tobytes() == other.frame.rgb.tobytes()
        assert own.relevance.target.tobytes() == other.relevance.target.tobytes()
    images = pager._images
    idle = len(mapper.store.buffer) - 2
    assert idle > 0
    assert images.size >= idle * (room_frame(0).rgb.nbytes + room_frame(0).depth_m.nbytes)
    del mapper, missions, own
    pager._parts.clear()
    assert images.size == 0


def test_without_room_the_images_stay_in_memory() -> None:
    pager = disk_pager(max_bytes=0)
    map_tour(rooms_mission(rooms_mapper(pager)), 0, FRAMES)
    assert pager._images.size == 0
