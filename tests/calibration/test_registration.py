"""The estimate recovers a known colour camera, in a simulated home with a displaced depth camera."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tiny_sequences import write_replica, write_seven_scenes, write_tum

from gausslite.datasets.files import RgbdImage, resize_rgbd
from gausslite.datasets.open import open_source
from gausslite.datasets.source import WrappedSource
from gausslite.domain.camera import Camera, FileIntrinsics
from gausslite.domain.errors import DatasetError
from gausslite.domain.frame import Frame
from gausslite.domain.pose import inverse
from gausslite.domain.recording import DepthRegistration
from gausslite_calibration.depth_registration import RegistrationEstimate, estimate_from_frames, find_registration
from gausslite_calibration.registered import register_depth

DEPTH_CAMERA = Camera(300.0, 300.0, 162.0, 118.5, 320, 240)


def unregister(frame: Frame, T_colour_depth: np.ndarray, depth_camera: Camera = DEPTH_CAMERA) -> Frame:
    """Return the frame with the depth that a displaced camera would have measured."""
    depth_m = register_depth(frame.depth_m, frame.camera, depth_camera, inverse(T_colour_depth))
    return replace(frame, depth_m=depth_m, camera=depth_camera)


def test_a_known_colour_camera_is_estimated() -> None:
    pytest.importorskip("embreex", reason="the simulated home needs the extra `sim`")
    home = open_source("sim:home?seed=0&trajectory=0&frames=6&size=320x240&noise=0")
    frames = [home.frame(i) for i in range(len(home))]
    k = home.camera
    intrinsics = FileIntrinsics(k.fx_px, k.fy_px, k.cx_px - 0.5, k.cy_px - 0.5)
    truth = DepthRegistration(intrinsics, (-0.03, 0.01, 0.0), (0.0, 0.0, 0.8))
    found = estimate_from_frames([unregister(frame, truth.extrinsics()) for frame in frames])
    assert found.score > 1.2 * found.unregistered_score
    assert found.registration.intrinsics.fx == pytest.approx(truth.intrinsics.fx, rel=0.01)
    assert found.registration.offset_m == pytest.approx(truth.offset_m, abs=0.004)
    assert found.registration.rotation_deg == pytest.approx(truth.rotation_deg, abs=0.15)
    assert found.registration.intrinsics.cx == pytest.approx(truth.intrinsics.cx, abs=1.0)
    assert found.registration.intrinsics.cy == pytest.approx(truth.intrinsics.cy, abs=1.0)


@pytest.mark.slow
def test_a_colour_camera_of_another_focal_length_is_estimated() -> None:
    pytest.importorskip("embreex", reason="the simulated home needs the extra `sim`")
    home = open_source("sim:home?seed=0&trajectory=0&frames=6&size=320x240&noise=0")
    k = home.camera
    truth = DepthRegistration(FileIntrinsics(k.fx_px, k.fy_px, k.cx_px - 0.5, k.cy_px - 0.5), (-0.03, 0.01, 0.0))
    narrow = replace(DEPTH_CAMERA, fx_px=k.fx_px / 0.85, fy_px=k.fy_px / 0.85)
    frames = [unregister(home.frame(i), truth.extrinsics(), narrow) for i in range(len(home))]
    found = estimate_from_frames(frames)
    assert found.is_reliable
    assert found.registration.intrinsics.fx == pytest.approx(truth.intrinsics.fx, rel=0.01)
    assert found.registration.offset_m == pytest.approx(truth.offset_m, abs=0.004)


def test_an_estimate_is_reliable_only_with_a_clearly_higher_score() -> None:
    camera = DepthRegistration(FileIntrinsics(525.0, 525.0, 320.0, 240.0))
    assert RegistrationEstimate(camera, score=1.89, unregistered_score=0.84, edge_points=130_000).is_reliable
    # the images are registered
    assert not RegistrationEstimate(camera, score=1.89, unregistered_score=1.8, edge_points=130_000).is_reliable
    # better than as recorded, but close to chance
    assert not RegistrationEstimate(camera, score=1.27, unregistered_score=0.76, edge_points=4_000).is_reliable


class EnlargedSource(WrappedSource):
    """Another source, enlarged four times in both directions."""

    @property
    def camera(self) -> Camera:
        k = self._source.camera
        return k.resized(4 * k.width_px, 4 * k.height_px)

    def frame(self, i: int, size: tuple[int, int] | None = None) -> Frame:
        frame = self._source.frame(i)
        big = RgbdImage(
            np.repeat(np.repeat(frame.rgb, 4, 0), 4, 1), np.repeat(np.repeat(frame.depth_m, 4, 0), 4, 1), self.camera
        )
        image = resize_rgbd(big, size)
        return replace(frame, rgb=image.rgb, depth_m=image.depth_m, camera=image.camera)


@pytest.mark.slow
def test_the_camera_of_large_images_is_estimated() -> None:
    pytest.importorskip("embreex", reason="the simulated home needs the extra `sim`")
    k = open_source("sim:home?frames=6&size=320x240").camera
    large = k.resized(4 * k.width_px, 4 * k.height_px)
    truth = DepthRegistration(FileIntrinsics(k.fx_px, k.fy_px, k.cx_px - 0.5, k.cy_px - 0.5), (-0.05, 0.0, 0.0))
    found, _ = find_registration(EnlargedSource(UnregisteredSource(truth)))
    assert found is not None
    assert found.offset_m == pytest.approx(truth.offset_m, abs=0.006)
    assert found.intrinsics.fx == pytest.approx(large.fx_px, rel=0.01)
    assert found.intrinsics.cx == pytest.approx(large.cx_px - 0.5, abs=4.0)
    assert found.intrinsics.cy == pytest.approx(large.cy_px - 0.5, abs=4.0)


class UnregisteredSource(WrappedSource):
    """The simulated home with a displaced depth camera, as in a recording without registration."""

    camera = DEPTH_CAMERA
    depth_registered = camera_ideal = poses_exact = depth_unit_stated = False

    def __init__(self, truth: DepthRegistration) -> None:
        super().__init__(open_source("sim:home?seed=0&trajectory=0&frames=6&size=320x240&noise=0"))
        self._T_colour_depth = truth.extrinsics()
        self.damaged: int | None = None

    def frame(self, i: int, size: tuple[int, int] | None = None) -> Frame:
        assert size is None
        if i == self.damaged:
            raise DatasetError("unregistered: expected a whole image file, got one cut short")
        return unregister(self._source.frame(i), self._T_colour_depth)


@pytest.mark.slow
def test_unregistered_depth_gets_the_estimated_registration() -> None:
    pytest.importorskip("embreex", reason="the simulated home needs the extra `sim`")
    k = open_source("sim:home?frames=6&size=320x240").camera
    truth = DepthRegistration(FileIntrinsics(k.fx_px, k.fy_px, k.cx_px - 0.5, k.cy_px - 0.5), (-0.05, 0.0, 0.0))
    source = UnregisteredSource(truth)
    source.damaged = 2
    found, why = find_registration(source)
    assert found is not None
    assert found.offset_m == pytest.approx(truth.offset_m, abs=0.006)
    assert "with the estimate" in why
    source.depth_registered = True
    assert find_registration(source) == (None, "depth is registered to colour in this layout")


@pytest.mark.parametrize(
    ("write", "registered"), [(write_tum, True), (write_replica, True), (write_seven_scenes, False)]
)
def test_each_layout_states_whether_depth_is_registered(write, registered: bool, tmp_path: Path) -> None:
    source = open_source(str(write(tmp_path / "fr1")))
    assert source.depth_registered is registered
    camera, why = find_registration(source)
    assert camera is None
    assert registered or "expected at least 1000 depth edge points" in why


def test_images_without_depth_edges_are_rejected() -> None:
    camera = Camera(50.0, 50.0, 32.0, 24.0, 64, 48)
    wall = Frame(0, 0, np.zeros((48, 64, 3), np.uint8), np.ones((48, 64), np.float32), camera, np.eye(4))
    pytest.raises(DatasetError, estimate_from_frames, [wall]).match("expected at least 1000 depth edge points, got 0")
    pytest.raises(DatasetError, estimate_from_frames, []).match("got 0")
