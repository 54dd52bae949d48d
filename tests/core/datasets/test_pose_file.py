"""Pose files in TUM's format: what is written is read, and damaged rows are named."""

from pathlib import Path

import numpy as np
import pytest
from tiny_sequences import write_replica, write_seven_scenes, write_tum

from gausslite.datasets.open import open_reference, open_source
from gausslite.datasets.pose_track import format_pose_rows, read_pose_rows
from gausslite.domain.errors import DatasetError, GaussLiteError
from gausslite.domain.pose import transform_of


@pytest.mark.parametrize("turn_rad", [0.0, 1e-9, 1.0, 3.0])
def test_poses_are_read_as_written(tmp_path: Path, turn_rad: float) -> None:
    rng = np.random.default_rng(0)
    axes = rng.normal(0, 1, (20, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    poses = np.array([transform_of(np.append(rng.normal(0, 3, 3), turn_rad * axis)) for axis in axes])
    times_ns = np.sort(rng.integers(0, 2_000_000_000, 20)) + 1_700_000_000_000_000_000
    path = tmp_path / "poses.txt"
    path.write_text(format_pose_rows("test", times_ns, poses))
    read_ns, read = read_pose_rows(path)
    np.testing.assert_allclose(read, poses, atol=1e-7)
    assert np.abs(read_ns - times_ns).max() < 1000  # a float64 of seconds since 1970 resolves 0.2 microseconds


@pytest.mark.parametrize(
    "row", ["", "1 2 3", "nan 0 0 0 0 0 0 1", "1e300 0 0 0 0 0 0 1", "1 0 0 0 0 0 0 7", "1 a 0 0 0 0 0 1"]
)
def test_a_damaged_row_is_named(tmp_path: Path, row: str) -> None:
    path = tmp_path / "poses.txt"
    path.write_text(f"# comment\n{row}\n")
    pytest.raises(GaussLiteError, read_pose_rows, path).match(r"poses\.txt")


@pytest.mark.parametrize(
    ("write", "pose_files"),
    [(write_tum, "groundtruth.txt"), (write_seven_scenes, "*.pose.txt"), (write_replica, "traj.txt")],
)
def test_a_sequence_without_poses_opens_for_tracking_only(tmp_path: Path, write, pose_files: str) -> None:
    folder = write(tmp_path / "rgbd_dataset_freiburg1_x")
    with_poses = [open_source(str(folder)).frame(i) for i in range(3)]
    for path in folder.glob(pose_files):
        path.unlink()
    with pytest.raises(DatasetError):
        open_source(str(folder)).frame(0)
    source = open_source(str(folder), require_poses=False)
    assert len(source) == len(with_poses)
    for i in range(len(source)):
        np.testing.assert_array_equal(source.frame(i).T_world_camera, np.eye(4))
        np.testing.assert_array_equal(source.frame(i).rgb, with_poses[i].rgb)
    assert source.up_axis == (0.0, -1.0, 0.0)


def test_the_reference_of_a_drifting_home_is_exact() -> None:
    spec = "sim:home?drift=5%&frames=6&size=16x16"
    drifting, reference = open_source(spec).trajectory(), open_reference(spec)
    assert reference is not None
    exact = open_source("sim:home?frames=6&size=16x16").trajectory()
    np.testing.assert_array_equal(reference.trajectory().T_world_camera, exact.T_world_camera)
    np.testing.assert_array_equal(drifting.T_world_camera[0], exact.T_world_camera[0])
    moved_m = np.linalg.norm(np.diff(exact.T_world_camera[:, :3, 3], axis=0), axis=1).sum()
    drift_m = np.linalg.norm(drifting.T_world_camera[-1, :3, 3] - exact.T_world_camera[-1, :3, 3])
    assert 0.001 < drift_m < 0.5 * moved_m
    for other in ("sim:home?frames=6&drift=5%", "sim:home?drift=5%"):
        assert open_reference(other) is not None
