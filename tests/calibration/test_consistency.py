"""Poses or depth that contradict the images are refused with the convention, clock or unit that would agree."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from jaxtyping import Float64
from numpy import ndarray

from gausslite.datasets.calibration import StatedValues, as_recorded_notes
from gausslite.datasets.open import open_source
from gausslite.datasets.pose_track import pose_from_quaternion, quat_xyzw
from gausslite.datasets.source import Source, WrappedSource
from gausslite.domain.errors import DatasetError
from gausslite.domain.frame import Frame
from gausslite.domain.lens import Lens, LensModel
from gausslite.domain.pose import Trajectory, transform_of
from gausslite.domain.recording import CameraCorrection, PoseExposurePrior
from gausslite_calibration.calibrate import calibrate, contradictions
from gausslite_calibration.consistency import find_contradiction
from gausslite_calibration.depth_consistency import best_factor

Poses = Float64[ndarray, "n 4 4"]
SIZE = (160, 120)
NOTHING_ESTIMATED = StatedValues(correction=CameraCorrection(), pose_prior=PoseExposurePrior())


@cache
def frame_of(home: Source, position: int) -> Frame:
    """Return a frame that is rendered once for all tests."""
    return home.frame(position, SIZE)


class Recording(WrappedSource):
    """Frames of a simulated home that state neither exact poses nor an ideal camera; 30 frames a second."""

    camera_ideal = poses_exact = False
    depth_unit_stated = depth_registered = True

    def __init__(self, home: Source, positions: list[int]) -> None:
        super().__init__(home)
        self.frames = [frame_of(home, position) for position in positions]
        self.poses = np.array([frame.T_world_camera for frame in self.frames])
        self.depth_factor = 1.0

    def __len__(self) -> int:
        return len(self.frames)

    def frame(self, i: int, size: tuple[int, int] | None = None) -> Frame:
        depth_m = self.frames[i].depth_m * np.float32(self.depth_factor)
        return replace(self.frames[i], depth_m=depth_m, T_world_camera=self.poses[i])

    def trajectory(self) -> Trajectory:
        return Trajectory(np.arange(len(self.frames)) / 30.0, self.poses)


@pytest.fixture(scope="module")
def home() -> Source:
    return open_source("sim:home?size=160x120")


@pytest.fixture
def recording(home: Source) -> Recording:
    return Recording(home, list(range(14)))


def with_w_first(T: Float64[ndarray, "4 4"]) -> Float64[ndarray, "4 4"]:
    """Return the pose of a file that states w x y z where x y z w is read."""
    return pose_from_quaternion("pose", T[:3, 3], np.roll(quat_xyzw(T[:3, :3]), 1))


def with_axes(x: tuple[int, ...], y: tuple[int, ...], z: tuple[int, ...]) -> Callable[[Poses], Poses]:
    """Return poses of a camera frame with these axes, each given in x right, y down, z forward."""
    axes = np.eye(4)
    axes[:3, :3] = np.array([x, y, z]).T
    return lambda poses: poses @ axes


def transposed_rotations(poses: Poses) -> Poses:
    turned = poses.copy()
    turned[:, :3, :3] = poses[:, :3, :3].transpose(0, 2, 1)
    return turned


def mirrored(poses: Poses) -> Poses:
    """Return the poses in left-handed worlds and cameras with y up."""
    mirror = np.diag([1.0, -1.0, 1.0, 1.0])
    return mirror @ poses @ mirror


def in_millimetres(poses: Poses) -> Poses:
    scaled = poses.copy()
    scaled[:, :3, 3] *= 1000.0
    return scaled


CONVENTIONS: dict[str, tuple[Callable[[Poses], Poses], str]] = {
    "inverse": (np.linalg.inv, "poses read as world-to-camera poses would agree"),
    "opengl": (with_axes((1, 0, 0), (0, -1, 0), (0, 0, -1)), "x right, y up, z backward \\(OpenGL\\) would agree"),
    "body": (with_axes((0, 0, 1), (-1, 0, 0), (0, -1, 0)), "x forward, y left, z up \\(robot's body\\) would agree"),
    "left-handed": (mirrored, "camera axes x right, y up, z forward would agree"),
    "quaternion": (lambda poses: np.array([with_w_first(T) for T in poses]), "quaternions with w first would agree"),
    "rotations": (transposed_rotations, "rotations from world to camera would agree"),
    "millimetres": (in_millimetres, "depth multiplied by (990|1000) "),
}


@pytest.mark.parametrize("name", CONVENTIONS)
def test_another_convention_of_poses_is_named(recording: Recording, name: str) -> None:
    change, message = CONVENTIONS[name]
    recording.poses = change(recording.poses)
    with pytest.raises(DatasetError, match=f"do not fit the images .* {message}.*--set force=true"):
        calibrate(recording, NOTHING_ESTIMATED)


@pytest.mark.parametrize(
    ("factor", "words"), [(0.2, "multiplied by 5"), (0.5, "multiplied by 2"), (10.0, "divided by 10")]
)
def test_another_unit_of_depth_is_named(recording: Recording, factor: float, words: str) -> None:
    recording.depth_factor = factor
    pytest.raises(DatasetError, calibrate, recording, NOTHING_ESTIMATED).match(f"depth {words} ")


def test_depth_images_decide_where_features_err(recording: Recording) -> None:
    """Where depth and colour are not registered, features of the real kitchen find 3.4 to 7.4 instead of 5."""
    recording.depth_factor = 0.2
    for biased in (3.4, 7.4):
        assert best_factor(recording, recording.trajectory(), biased) == pytest.approx(5.0, rel=0.04)
    few = Recording(recording, [0, 1])
    assert best_factor(few, few.trajectory(), 7.4) == 7.4


@pytest.mark.slow
def test_another_clock_is_named(home: Source) -> None:
    recording = Recording(home, [*range(24), *range(22, -1, -1)])
    recording.poses = np.roll(recording.poses, 6, axis=0)
    contradiction = find_contradiction(recording)
    assert "poses 0.20 s later (clocks" in str(contradiction)


def test_poses_of_another_recording_are_refused(recording: Recording) -> None:
    recording.poses = recording.poses[np.random.default_rng(1).permutation(len(recording.poses))]
    with pytest.raises(DatasetError, match="no other convention, clock or unit of depth agrees"):
        calibrate(recording, NOTHING_ESTIMATED)


@pytest.mark.slow
def test_right_poses_agree_also_with_their_usual_errors(recording: Recording) -> None:
    assert find_contradiction(recording) is None
    rng = np.random.default_rng(0)
    errors = rng.normal(0.0, [0.005] * 3 + [0.005] * 3, (len(recording.poses), 6))
    recording.poses = np.array([T @ transform_of(error) for T, error in zip(recording.poses, errors, strict=True)])
    recording.depth_factor = 1.05
    assert find_contradiction(recording) is None


def test_a_camera_at_rest_and_images_without_features_give_no_verdict(home: Source, recording: Recording) -> None:
    still = Recording(home, [3] * 12)
    still.poses = np.linalg.inv(still.poses)
    assert find_contradiction(still) is None
    recording.frames = [replace(frame, rgb=np.zeros_like(frame.rgb)) for frame in recording.frames]
    recording.poses = np.linalg.inv(recording.poses)
    assert find_contradiction(recording) is None


def test_contradictory_poses_are_used_on_request_without_estimates(recording: Recording) -> None:
    recording.poses = np.linalg.inv(recording.poses)
    found = calibrate(recording, StatedValues(force=True))
    assert [(note.split(" (")[0], "world-to-camera" in note) for note in found.notes] == [
        ("poses and depth do not fit the images", True)
    ]
    assert (found.correction.is_identity, found.pose_prior.is_exact) == (True, True)
    assert calibrate(recording, replace(NOTHING_ESTIMATED, checked=True)).notes == ()


def test_a_wrong_unit_that_the_files_do_not_state_is_noted(recording: Recording) -> None:
    recording.depth_unit_stated, recording.depth_factor = False, 0.2
    [note] = calibrate(recording).notes
    assert "depth multiplied by" in note
    assert note.endswith("scale in the camera file of a folder, or as depth_unit=Xmm in the address of a bag")
    recording.poses = np.linalg.inv(recording.poses)
    pytest.raises(DatasetError, calibrate, recording).match("world-to-camera")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["tum_fr1", "redkitchen", "hololens_kitchenette"])
def test_real_recordings_agree(shared_dir, name: str) -> None:
    assert find_contradiction(open_source(str(shared_dir / "data" / name))) is None


def test_another_focal_length_is_named(recording: Recording) -> None:
    camera = recording.frames[0].camera
    with_camera(recording, fx_px=2.0 * camera.fx_px, fy_px=2.0 * camera.fy_px)
    with pytest.raises(DatasetError, match=r"focal length divided by (1\.9|2|2\.1) \(intrinsics of another size"):
        calibrate(recording, NOTHING_ESTIMATED)


def with_camera(recording: Recording, **changed_px: float) -> None:
    recording.frames = [replace(frame, camera=replace(frame.camera, **changed_px)) for frame in recording.frames]


@pytest.mark.slow
def test_another_principal_point_or_ratio_of_focal_lengths_is_named(home: Source) -> None:
    recording = Recording(home, list(range(0, 81, 2)))
    camera = recording.frames[0].camera
    with_camera(recording, cx_px=camera.cx_px + 0.15 * camera.width_px)
    with pytest.raises(DatasetError, match=r"principal point moved by \(-2\d, -?\d\) px \(intrinsics of"):
        calibrate(recording, NOTHING_ESTIMATED)
    with_camera(recording, cx_px=camera.cx_px, fy_px=1.3 * camera.fy_px)
    with pytest.raises(DatasetError, match=r"the camera's focal length fy divided by 1\.3 \(intrinsics of"):
        calibrate(recording, NOTHING_ESTIMATED)


@pytest.mark.slow
def test_depth_along_the_ray_is_named(recording: Recording) -> None:
    camera = recording.frames[0].camera
    x, y = camera.slopes(np.arange(camera.width_px) + 0.5, np.arange(camera.height_px) + 0.5)
    stretch = np.sqrt(1.0 + x[None, :] ** 2 + y[:, None] ** 2).astype(np.float32)
    recording.frames = [replace(frame, depth_m=frame.depth_m * stretch) for frame in recording.frames]
    with pytest.raises(DatasetError, match="depth along the ray of each pixel instead of the optical axis would agree"):
        calibrate(recording, NOTHING_ESTIMATED)


@pytest.mark.slow
def test_mirrored_depth_images_are_named(recording: Recording) -> None:
    recording.frames = [replace(frame, depth_m=frame.depth_m[:, ::-1].copy()) for frame in recording.frames]
    with pytest.raises(DatasetError, match="depth images mirrored left to right would agree"):
        calibrate(recording, NOTHING_ESTIMATED)


FEW: dict[str, tuple[Callable[[Poses], Poses], float, str]] = {
    "inverse": (np.linalg.inv, 1.0, "poses read as world-to-camera poses would agree"),
    "quaternion": (CONVENTIONS["quaternion"][0], 1.0, "quaternions with w first would agree"),
    "unit": (lambda poses: poses, 0.2, "depth multiplied by 5 "),
}


@pytest.mark.parametrize("name", FEW)
def test_few_frames_far_apart_name_what_would_agree(home: Source, name: str) -> None:
    recording = Recording(home, [20, 27, 34, 41, 48])
    assert find_contradiction(recording) is None
    change, recording.depth_factor, words = FEW[name]
    recording.poses = change(recording.poses)
    pytest.raises(DatasetError, calibrate, recording, NOTHING_ESTIMATED).match(words)


@pytest.mark.slow
def test_depth_images_with_swapped_bytes_are_refused(recording: Recording) -> None:
    swapped = [np.round(1000 * frame.depth_m).astype(np.uint16).byteswap() / 1000 for frame in recording.frames]
    recording.frames = [
        replace(frame, depth_m=depth_m.astype(np.float32))
        for frame, depth_m in zip(recording.frames, swapped, strict=True)
    ]
    pytest.raises(DatasetError, calibrate, recording, NOTHING_ESTIMATED).match("do not fit")


def test_poses_of_another_link_are_named(home: Source) -> None:
    recording = Recording(home, list(range(0, 72, 2)))
    mount = transform_of(np.array([0.1, -0.2, 0.15, 0.0, 0.25, 0.1]))
    recording.poses = np.array([T @ mount for T in recording.poses])
    with pytest.raises(
        DatasetError, match=r"another link than the camera, which is turned by 1\d degrees .* would agree"
    ):
        calibrate(recording, NOTHING_ESTIMATED)


@pytest.mark.parametrize(("late", "words"), [(4, r"0\.13 s \(4 frames\) later"), (-2, r"0\.07 s \(2 frames\) earlier")])
def test_depth_images_of_another_time_are_named(home: Source, late: int, words: str) -> None:
    recording = Recording(home, list(range(24)))
    depths = [recording.frames[min(max(i - late, 0), 23)].depth_m for i in range(24)]
    recording.frames = [replace(frame, depth_m=depth) for frame, depth in zip(recording.frames, depths, strict=True)]
    pytest.raises(DatasetError, calibrate, recording, NOTHING_ESTIMATED).match(f"depth images {words} would agree")


@pytest.mark.slow
def test_depth_images_that_are_late_by_one_frame_are_noted(home: Source) -> None:
    recording = Recording(home, list(range(24)))
    depths = [recording.frames[max(i - 1, 0)].depth_m for i in range(24)]
    recording.frames = [replace(frame, depth_m=depth) for frame, depth in zip(recording.frames, depths, strict=True)]
    [note] = calibrate(recording, NOTHING_ESTIMATED).notes
    assert "depth images 0.03 s (1 frame) later would agree" in note


def jump(poses: Poses) -> Poses:
    moved = poses.copy()
    moved[7:, 0, 3] += 0.4
    return moved


def spikes(poses: Poses) -> Poses:
    moved = poses.copy()
    moved[[3, 10], 1, 3] += 0.4
    return moved


def standstill(poses: Poses) -> Poses:
    still = poses.copy()
    still[9:] = poses[9]
    return still


@pytest.mark.slow
@pytest.mark.parametrize("change", [jump, spikes, standstill])
def test_poses_that_do_not_fit_in_places_are_noted(home: Source, change: Callable[[Poses], Poses]) -> None:
    recording = Recording(home, list(range(0, 42, 3)))
    recording.poses = change(recording.poses)
    [note] = calibrate(recording, NOTHING_ESTIMATED).notes
    assert note.startswith("poses do not fit the images from frame ")
    assert "was tracking lost there?" in note


class Distorted(Recording):
    """Depth that may not be registered, and a lens that is nearly a pinhole's."""

    depth_registered, lens = False, Lens(LensModel.RADTAN, (1e-4, 0.0, 0.0, 0.0))


def test_a_recording_used_as_it_is_has_notes_on_its_depth_lens_and_poses(home: Source) -> None:
    recording = Distorted(home, list(range(14)))
    recording.poses = np.linalg.inv(recording.poses)
    depth, lens = as_recorded_notes(recording)
    [poses] = contradictions(recording)
    assert "does not state whether depth is registered" in depth
    assert "the lens radtan:0.0001,0,0,0, which is not corrected" in lens
    assert "world-to-camera poses would agree" in poses
