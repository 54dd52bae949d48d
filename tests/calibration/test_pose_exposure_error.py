"""The estimated prior is exact for exact poses, and about as large as the true errors otherwise."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from gausslite.datasets.files import RgbdImage, resize_rgbd
from gausslite.datasets.open import open_source
from gausslite.datasets.source import Source, WrappedSource
from gausslite.domain.errors import DatasetError
from gausslite.domain.frame import Frame
from gausslite.domain.pose import Trajectory
from gausslite_calibration.pose_errors import estimate_pose_exposure_prior

FRAMES = 40
pytest.importorskip("embreex", reason="the simulated home needs the extra `sim`")

pytestmark = pytest.mark.slow


class Recording(WrappedSource):
    """A trajectory through a simulated home with pose errors and automatic exposure."""

    name = "recording"
    camera_ideal = poses_exact = depth_unit_stated = False

    def __init__(self, home: Source, translation_m: float, rotation_deg: float, gain: float = 0.0) -> None:
        super().__init__(home)
        self._frames = [home.frame(i) for i in range(FRAMES)]
        self.damaged: set[int] = set()
        rng = np.random.default_rng(0)
        self._T_true_recorded = [np.eye(4) for _ in range(FRAMES)]
        for T in self._T_true_recorded:
            T[:3, :3] = cv2.Rodrigues(np.radians(rng.normal(0.0, rotation_deg, 3)))[0]
            T[:3, 3] = rng.normal(0.0, translation_m, 3)
        self._gains = rng.normal(1.0, gain, FRAMES)

    def __len__(self) -> int:
        return FRAMES

    def frame(self, i: int, size: tuple[int, int] | None = None) -> Frame:
        if i in self.damaged:
            raise DatasetError("recording: expected a whole image file, got one cut short")
        frame = self._frames[i]
        image = resize_rgbd(RgbdImage(frame.rgb, frame.depth_m, self.camera), size)
        rgb = np.clip(image.rgb * self._gains[i], 0, 255).astype(np.uint8)
        T_world_camera = frame.T_world_camera @ self._T_true_recorded[i]
        return replace(frame, rgb=rgb, depth_m=image.depth_m, camera=image.camera, T_world_camera=T_world_camera)

    def indices(self) -> list[int]:
        return list(range(FRAMES))

    def trajectory(self) -> Trajectory:
        return Trajectory(np.arange(FRAMES) / 30, np.array([self.frame(i).T_world_camera for i in range(FRAMES)]))


@pytest.fixture(scope="module")
def home() -> Source:
    """Return a simulated home with the depth noise, holes and flying pixels of a sensor."""
    return open_source(f"sim:home-7?seed=0&trajectory=0&frames={FRAMES}&size=200x150&exposure=0")


def test_exact_poses_give_an_exact_prior(home: Source) -> None:
    prior, reason = estimate_pose_exposure_prior(Recording(home, 0.0, 0.0))
    assert prior.is_exact
    assert reason.startswith("24 pairs of frames agree to ")


@pytest.mark.parametrize(("translation_m", "rotation_deg"), [(0.01, 0.5), (0.005, 0.2)])
def test_the_estimated_pose_error_is_about_the_true_one(
    home: Source, translation_m: float, rotation_deg: float
) -> None:
    prior, _ = estimate_pose_exposure_prior(Recording(home, translation_m, rotation_deg))
    assert translation_m / 2 < prior.translation_m < translation_m * 1.5
    assert rotation_deg / 2 < prior.rotation_deg < rotation_deg * 1.5


def test_a_changing_exposure_is_estimated_in_spite_of_pose_errors(home: Source) -> None:
    fixed, changing = (estimate_pose_exposure_prior(Recording(home, 0.01, 0.5, gain))[0] for gain in (0.0, 0.2))
    assert 1.5 * fixed.gain < changing.gain < 0.3


def test_unreadable_frames_are_ignored_and_too_few_pairs_give_no_estimate(home: Source) -> None:
    recording = Recording(home, 0.01, 0.5)
    recording.damaged = set(range(0, FRAMES, 4))
    assert estimate_pose_exposure_prior(recording)[0].has_pose_error
    recording.damaged = set(range(2, FRAMES))
    prior, reason = estimate_pose_exposure_prior(recording)
    assert prior.is_exact
    assert reason.endswith("pairs of frames overlap, too few for an estimate")
