"""The pose history: corrections by time, their mean, a bounded size; anchored poses stay near the odometry's frame."""

from dataclasses import replace

import numpy as np
import pytest
from mapping_scenes import map_frame, wall_frame

from gausslite.domain.errors import GaussLiteError
from gausslite.domain.frame import Frame
from gausslite.domain.pose import CorrectionTrack, inverse, transform_of, translation_m, twist_of
from gausslite.mapping.poses import PoseTable

SMALL = wall_frame(size=(4, 3))


def odometry(index: int, x_m: float = 0.0) -> Frame:
    """Return a tiny frame at 10 Hz."""
    return replace(SMALL, index=index, capture_time_ns=index * 100_000_000, T_world_camera=shift(x_m))


def record(table: PoseTable, frame: Frame, T_world_map: np.ndarray) -> None:
    """Map a frame with the odometry's pose, or refine it again."""
    if list(frame.id) not in table.state()["frames"].tolist():
        table.add(frame, 0)
    table.refine(frame.id, T_world_map)


def shift(x_m: float) -> np.ndarray:
    return transform_of(np.array([x_m, 0.0, 0.0, 0.0, 0.0, 0.0]))


def test_a_frame_refined_again_replaces_its_pose_and_counts_once() -> None:
    history = PoseTable()
    for x_m in (0.1, 0.3):
        record(history, odometry(0), shift(x_m))
    record(history, odometry(1), shift(0.1))
    assert len(history) == 2
    np.testing.assert_allclose(history.mean_correction, [0.2, 0, 0, 0, 0, 0], atol=1e-12)
    corrections = history.corrections()
    assert corrections is not None
    np.testing.assert_allclose(corrections.T_map_odometry[:, 0, 3], [0.3, 0.1])


def test_a_frame_that_comes_again_gets_a_new_row() -> None:
    table = PoseTable()
    record(table, odometry(0), shift(0.1))
    table.add(odometry(0, x_m=1.0), 0)
    table.refine(odometry(0).id, shift(1.2))
    assert len(table) == 1
    np.testing.assert_allclose(table.mean_correction, [0.2, 0, 0, 0, 0, 0], atol=1e-12)


def test_the_correction_maps_the_odometrys_pose_to_the_maps() -> None:
    rng = np.random.default_rng(0)
    history, pairs = PoseTable(), []
    for index in range(5):
        T_odometry, T_map = (transform_of(rng.normal(0, 1, 6)) for _ in range(2))
        record(history, replace(odometry(index), T_world_camera=T_odometry), T_map)
        pairs.append((T_odometry, T_map))
    corrections, latest = history.corrections(), history.latest()
    assert corrections is not None
    assert latest is not None
    for T_map_odometry, (T_odometry, T_map) in zip(corrections.T_map_odometry, pairs, strict=True):
        np.testing.assert_allclose(T_map_odometry @ T_odometry, T_map, atol=1e-12)
    np.testing.assert_array_equal(latest.T_map_odometry, corrections.T_map_odometry[-1])
    assert latest.capture_time_ns == 400_000_000


def test_the_uncertainty_is_the_change_between_successive_frames() -> None:
    history = PoseTable()
    for index in range(10):
        record(history, odometry(index), shift(0.03 * (index % 2)))
    latest = history.latest()
    assert latest is not None
    assert latest.translation_std_m == pytest.approx(0.03 / np.sqrt(3))  # the change is along one of three axes
    assert latest.rotation_std_deg == pytest.approx(0.0, abs=1e-9)


def test_a_long_mission_keeps_the_newest_poses_and_thins_older_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gausslite.mapping.poses._MAX_POSES", 20)
    history = PoseTable()
    for index in range(100):
        record(history, odometry(index), shift(0.01))
        assert len(history) <= 20
    corrections = history.corrections()
    assert corrections is not None
    times = (corrections.times_ns // 100_000_000).tolist()
    assert times[0] == 0
    assert times[-5:] == [95, 96, 97, 98, 99]
    np.testing.assert_allclose(history.mean_correction[0], 0.01)


def test_a_restored_history_continues_with_the_same_bits() -> None:
    rng = np.random.default_rng(1)
    first, second = PoseTable(), PoseTable()
    poses = [transform_of(rng.normal(0, 0.1, 6)) for _ in range(30)]
    for index, T in enumerate(poses[:20]):
        record(first, odometry(index % 13), T)
    second.restore(first.state())
    for index, T in enumerate(poses[20:]):
        record(first, odometry(index), T)
        record(second, odometry(index), T)
    assert first.mean_correction.tobytes() == second.mean_correction.tobytes()


@pytest.mark.parametrize("name", ["correction_sum", "T_world_map", "T_world_odometry"])
@pytest.mark.parametrize("value", [np.nan, 1e30])
def test_a_forged_state_is_refused(name: str, value: float) -> None:
    history = PoseTable()
    record(history, odometry(0), shift(0.1))
    state = {key: array.copy() for key, array in history.state().items()}
    state[name].flat[3] = value
    pytest.raises(GaussLiteError, PoseTable().restore, state).match("state")


def test_corrections_between_frames_are_interpolated_and_live_ones_are_the_last() -> None:
    track = CorrectionTrack(np.array([0, 100], np.int64), np.stack([shift(0.0), shift(1.0)]))
    for time_ns, between, before in ((-5, 0.0, 0.0), (0, 0.0, 0.0), (25, 0.25, 0.0), (100, 1.0, 0.0), (300, 1.0, 1.0)):
        assert track.interpolated(time_ns)[0, 3] == pytest.approx(between)
        assert track.before(time_ns)[0, 3] == pytest.approx(before)
    turned = CorrectionTrack(
        np.array([0, 10], np.int64), np.stack([np.eye(4), transform_of(np.array([0, 0, 0, 0, 0, 1.0]))])
    )
    np.testing.assert_allclose(twist_of(turned.interpolated(5))[5], 0.5)


def test_frames_with_exact_poses_have_no_correction() -> None:
    from gausslite.mapping.mapper import GaussianMapper
    from gausslite.mapping.settings import MapperSettings
    from gausslite.render.cpu import CpuRasterizer

    mapper = GaussianMapper(MapperSettings(max_gaussians=500), CpuRasterizer(threads=1))
    for index in range(3):
        frame = wall_frame(index, shift_m=0.05 * index)
        mapped = map_frame(mapper, frame)
        assert mapped.T_world_camera is not None
        assert translation_m(mapped.T_world_camera, frame.T_world_camera) == 0
    corrections = mapper.poses.corrections()
    assert corrections is not None
    assert corrections.is_identity
    np.testing.assert_allclose(inverse(corrections.T_map_odometry[-1]), np.eye(4), atol=1e-12)
