"""Tracking: alignment recovers a motion, a walk is followed without its poses, a lost camera is found again."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from mapping_scenes import wall_frame

from gausslite.datasets.open import open_source
from gausslite.domain.errors import GaussLiteError
from gausslite.domain.frame import Frame
from gausslite.domain.pose import Trajectory, inverse, rotation_angle_deg, transform_of, translation_m
from gausslite.domain.state import select_prefix
from gausslite.mission.build import build_mapper, build_tracker
from gausslite.mission.localisation_monitor import LocalisationState
from gausslite.mission.settings import MissionSettings, PoseMode
from gausslite.mission.task_mapper import TaskMapper
from gausslite.perception.relevance import NoTaskEstimator
from gausslite.render.rasterizer import Rendering
from gausslite_evaluation.metrics import trajectory_error
from gausslite_poses.features import detect_features, relative_pose
from gausslite_poses.photometric import align
from gausslite_poses.tracking import CameraTracker, KeyframeIndex

PRIOR_STD = np.array([0.1] * 3 + [0.1] * 3)
SETTINGS = MissionSettings(policy="uniform", max_gaussians=20_000, iterations=4, threads=1, poses=PoseMode.TRACK)


@cache
def walk() -> Sequence[Frame]:
    """Return a walk of a simulated home."""
    source = open_source("sim:home?frames=60&size=160x120")
    return [source.frame(i) for i in range(24)]


def as_rendering(frame: Frame) -> Rendering:
    """Return the frame as the rendering of a perfect map."""
    alpha = (frame.depth_m > 0).astype(np.float32)
    return Rendering(frame.rgb / np.float32(255.0), frame.depth_m, alpha, None)


def without_pose(frame: Frame) -> Frame:
    return replace(frame, T_world_camera=np.eye(4))


def tracking_mapper() -> TaskMapper:
    mapper = build_mapper(SETTINGS)
    return TaskMapper(NoTaskEstimator(), mapper, tracker=build_tracker(SETTINGS, mapper))


def black(frame: Frame) -> Frame:
    """Return the frame as a covered camera sees it: no colour, and a surface at 10 cm."""
    return replace(frame, rgb=np.zeros_like(frame.rgb), depth_m=np.full_like(frame.depth_m, 0.1))


@pytest.mark.parametrize("twist", [(0.03, 0, 0, 0, 0, 0), (0, 0.02, 0.03, 0.02, 0, 0), (-0.02, 0, 0.02, 0, 0.03, 0.02)])
def test_alignment_recovers_a_motion(twist: tuple[float, ...]) -> None:
    source = open_source("sim:home?frames=400&size=160x120")
    frame, other = source.frame(0), source.frame(2)
    T_world_rendered = frame.T_world_camera @ transform_of(np.array(twist))
    truth = align(as_rendering(frame), frame.T_world_camera, other, PRIOR_STD)
    moved = align(as_rendering(frame), T_world_rendered, other, PRIOR_STD)
    assert truth is not None
    assert moved is not None
    assert truth.overlap > 0.8
    assert translation_m(truth.T_world_camera, other.T_world_camera) < 0.01
    assert rotation_angle_deg(truth.T_world_camera, other.T_world_camera) < 0.3
    # the result is relative to the rendering's pose
    expected = T_world_rendered @ inverse(frame.T_world_camera) @ truth.T_world_camera
    np.testing.assert_allclose(moved.T_world_camera, expected, atol=1e-6)


def test_a_map_without_surface_in_view_gives_no_alignment() -> None:
    frame = walk()[0]
    empty = Rendering(np.zeros((120, 160, 3), np.float32), *(np.zeros((120, 160), np.float32) for _ in range(2)), None)
    assert align(empty, frame.T_world_camera, frame, PRIOR_STD) is None
    assert align(as_rendering(frame), frame.T_world_camera, black(frame), PRIOR_STD) is None


def test_matched_features_give_the_relative_pose() -> None:
    # the median, because features near a threshold differ between processors
    frames = walk()
    features = [detect_features(frame) for frame in frames]
    errors = []
    for current in range(1, len(frames)):
        reference = frames[current - 1]
        pose = relative_pose(features[current - 1], features[current], reference.camera)
        assert pose is not None
        expected = inverse(frames[current].T_world_camera) @ reference.T_world_camera
        found = pose.T_current_reference
        errors.append((translation_m(found, expected), rotation_angle_deg(found, expected)))
    median_m, median_deg = np.median(errors, axis=0)
    assert median_m < 0.05
    assert median_deg < 2
    assert relative_pose(features[0], detect_features(black(frames[0])), frames[0].camera) is None


def test_a_walk_is_tracked_from_its_first_pose() -> None:
    mapper = tracking_mapper()
    start = walk()[0].T_world_camera
    for frame in walk():
        given = frame if frame.index == 0 else without_pose(frame)
        assert mapper.process(given).skipped is None
    true = Trajectory(
        np.array([frame.capture_time_ns / 1e9 for frame in walk()]), np.array([f.T_world_camera for f in walk()])
    )
    tracked = mapper.poses.trajectory()
    error = trajectory_error(tracked, true)
    assert error is not None
    assert error.poses == len(walk())
    moved_m = float(np.linalg.norm(np.diff(true.T_world_camera[:, :3, 3], axis=0), axis=1).sum())
    assert error.rmse_m < 0.05 * moved_m
    np.testing.assert_allclose(tracked.T_world_camera[0], start)
    assert mapper.tracking_counts["map"] >= len(walk()) - 2


def test_a_lost_camera_is_reported_and_found_again() -> None:
    mapper = tracking_mapper()
    for frame in walk()[:16]:
        mapper.process(frame)
    count = len(mapper.poses)
    covered = black(walk()[16])
    covered.rgb[: len(covered.rgb) // 2] = 40  # an image of one colour would be skipped before its pose is sought
    outcome = mapper.process(replace(covered, index=16))
    assert outcome.skipped is not None
    assert "lost" in outcome.skipped
    assert outcome.localisation is LocalisationState.LOST
    assert len(mapper.poses) == count
    assert mapper.tracking_counts["lost"] == 1
    # the camera returns to another place that the map shows
    back = replace(without_pose(walk()[4]), index=17, capture_time_ns=walk()[17].capture_time_ns)
    assert mapper.process(back).skipped is None
    assert mapper.localisation is LocalisationState.TRACKED
    assert mapper.tracking_counts["relocalisation"] == 1
    found = mapper.poses.trajectory().T_world_camera[-1]
    assert translation_m(found, walk()[4].T_world_camera) < 0.1


def test_a_restored_tracker_continues_with_the_same_bits() -> None:
    first, second = tracking_mapper(), tracking_mapper()
    for frame in walk()[:6]:
        first.process(without_pose(frame))
    second.restore({name: array.copy() for name, array in first.state().items()})
    for mapper in (first, second):
        for frame in walk()[6:9]:
            mapper.process(without_pose(frame))
    assert first.tracking_counts == second.tracking_counts
    a, b = first.gaussians(), second.gaussians()
    assert a.means_m.tobytes() == b.means_m.tobytes()


@pytest.mark.parametrize(
    "name", ["velocity", "last/T_world_camera", "last/features/points_m", "keyframes/T_world_camera"]
)
def test_a_forged_state_is_refused(name: str) -> None:
    mapper = tracking_mapper()
    for frame in walk()[:3]:
        mapper.process(frame)
    state = {key: array.copy() for key, array in select_prefix(mapper.state(), "tracker").items()}
    [key] = [key for key in state if key.replace(".", "/") == name]
    state[key].flat[0] = np.nan
    restored = CameraTracker(lambda camera, T_world_camera, motion: as_rendering(walk()[2]))
    pytest.raises(GaussLiteError, restored.restore, state).match("state")


def test_tracked_poses_move_with_their_keyframes() -> None:
    index, frame = KeyframeIndex(), wall_frame()
    for anchor, x_m in enumerate((0.0, 1.0)):
        index.add(detect_features(frame), transform_of(np.array([x_m, 0, 0, 0, 0, 0])), anchor)
    index.move(np.array([np.eye(4), transform_of(np.array([0, 0.5, 0, 0, 0, 0]))]))
    np.testing.assert_allclose(index.state()["T_world_camera"][:, :3, 3], [[0, 0, 0], [1, 0.5, 0]])
