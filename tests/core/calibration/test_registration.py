"""The colour camera is found again where it is known: the simulated home seen by a depth camera set beside it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tiny_sequences import write_replica, write_seven_scenes, write_tum

from gausslite.calibration.registration import Alignment, align, find_registration
from gausslite.datasets.images import RgbdImage, resize_rgbd
from gausslite.datasets.intrinsics import FileIntrinsics
from gausslite.datasets.open import open_source
from gausslite.datasets.registered_source import DepthRegistration, register_depth
from gausslite.domain.camera import Camera
from gausslite.domain.frame import Frame
from gausslite.domain.pose import inverse
from gausslite.domain.region import Region
from gausslite.errors import DatasetError

DEPTH_CAMERA = Camera(300.0, 300.0, 162.0, 118.5, 320, 240)


def unregister(frame: Frame, T_colour_depth: np.ndarray, depth_camera: Camera = DEPTH_CAMERA) -> Frame:
    """The same colour, with the depth a camera beside it would have measured."""
    depth_m = register_depth(frame.depth_m, frame.camera, depth_camera, inverse(T_colour_depth))
    return replace(frame, depth_m=depth_m, camera=depth_camera)


def test_a_known_colour_camera_is_found() -> None:
    pytest.importorskip("embreex", reason="the simulated home needs the extra `sim`")
    home = open_source("sim:home?seed=0&trajectory=0&frames=6&size=320x240&noise=0")
    frames = [home.frame(i) for i in range(len(home))]
    k = home.camera
    intrinsics = FileIntrinsics(k.fx_px, k.fy_px, k.cx_px - 0.5, k.cy_px - 0.5)
    truth = DepthRegistration(intrinsics, (-0.03, 0.01, 0.0), (0.0, 0.0, 0.8))
    found = align([unregister(frame, truth.depth_to_colour()) for frame in frames])
    assert found.score > 1.2 * found.score_before
    assert found.camera.intrinsics.fx == pytest.approx(truth.intrinsics.fx, rel=0.01)
    assert found.camera.offset_m == pytest.approx(truth.offset_m, abs=0.004)
    assert found.camera.turn_deg == pytest.approx(truth.turn_deg, abs=0.15)
    assert found.camera.intrinsics.cx == pytest.approx(truth.intrinsics.cx, abs=1.0)
    assert found.camera.intrinsics.cy == pytest.approx(truth.intrinsics.cy, abs=1.0)


def test_a_colour_camera_of_quite_another_focal_length_is_found() -> None:
    pytest.importorskip("embreex", reason="the simulated home needs the extra `sim`")
    home = open_source("sim:home?seed=0&trajectory=0&frames=6&size=320x240&noise=0")
    k = home.camera
    truth = DepthRegistration(FileIntrinsics(k.fx_px, k.fy_px, k.cx_px - 0.5, k.cy_px - 0.5), (-0.03, 0.01, 0.0))
    narrow = replace(DEPTH_CAMERA, fx_px=k.fx_px / 0.85, fy_px=k.fy_px / 0.85)
    frames = [unregister(home.frame(i), truth.depth_to_colour(), narrow) for i in range(len(home))]
    found = align(frames)
    assert found.convincing
    assert found.camera.intrinsics.fx == pytest.approx(truth.intrinsics.fx, rel=0.01)
    assert found.camera.offset_m == pytest.approx(truth.offset_m, abs=0.004)


def test_only_a_clear_find_convinces() -> None:
    camera = DepthRegistration(FileIntrinsics(525.0, 525.0, 320.0, 240.0))
    assert Alignment(camera, score=1.89, score_before=0.84, edge_points=130_000).convincing
    # the images are registered as they are
    assert not Alignment(camera, score=1.89, score_before=1.8, edge_points=130_000).convincing
    # half better than it was, and hardly better than chance
    assert not Alignment(camera, score=1.27, score_before=0.76, edge_points=4_000).convincing


class EnlargedSource:
    """Another source four times as wide and as high, as a camera of many pixels would record it."""

    def __init__(self, small: ApartSource) -> None:
        self._small = small
        k = small.camera
        self.camera = k.resized(4 * k.width_px, 4 * k.height_px)
        self.name, self.up_axis, self.depth_registered = "enlarged", small.up_axis, False
        self.excluded_frames = ""

    def __len__(self) -> int:
        return len(self._small)

    def frame(self, i: int, size: tuple[int, int] | None = None) -> Frame:
        seen = self._small.frame(i)
        big = RgbdImage(
            np.repeat(np.repeat(seen.rgb, 4, 0), 4, 1), np.repeat(np.repeat(seen.depth_m, 4, 0), 4, 1), self.camera
        )
        image = resize_rgbd(big, size)
        return replace(seen, rgb=image.rgb, depth_m=image.depth_m, camera=image.camera)

    def indices(self) -> list[int]:
        return self._small.indices()

    def regions(self) -> dict[str, Region]:
        return {}


def test_the_camera_of_large_images_is_found_too() -> None:
    pytest.importorskip("embreex", reason="the simulated home needs the extra `sim`")
    k = open_source("sim:home?frames=6&size=320x240").camera
    large = k.resized(4 * k.width_px, 4 * k.height_px)
    truth = DepthRegistration(FileIntrinsics(k.fx_px, k.fy_px, k.cx_px - 0.5, k.cy_px - 0.5), (-0.05, 0.0, 0.0))
    found, _ = find_registration(EnlargedSource(ApartSource(truth)))
    assert found is not None
    assert found.offset_m == pytest.approx(truth.offset_m, abs=0.006)
    assert found.intrinsics.fx == pytest.approx(large.fx_px, rel=0.01)
    assert found.intrinsics.cx == pytest.approx(large.cx_px - 0.5, abs=4.0)
    assert found.intrinsics.cy == pytest.approx(large.cy_px - 0.5, abs=4.0)


class ApartSource:
    """The simulated home with its depth camera beside the colour camera, as a recording that does not register it."""

    def __init__(self, truth: DepthRegistration) -> None:
        self._home = open_source("sim:home?seed=0&trajectory=0&frames=6&size=320x240&noise=0")
        self._T_colour_depth = truth.depth_to_colour()
        self.name, self.camera, self.up_axis = "apart", DEPTH_CAMERA, self._home.up_axis
        self.depth_registered = False
        self.excluded_frames = ""
        self.damaged: int | None = None

    def __len__(self) -> int:
        return len(self._home)

    def frame(self, i: int, size: tuple[int, int] | None = None) -> Frame:
        assert size is None
        if i == self.damaged:
            raise DatasetError("apart: expected a whole image file, got one cut short")
        return unregister(self._home.frame(i), self._T_colour_depth)

    def indices(self) -> list[int]:
        return list(range(len(self)))

    def regions(self) -> dict[str, Region]:
        return {}


def test_depth_that_is_not_registered_is_registered_to_what_the_images_say() -> None:
    pytest.importorskip("embreex", reason="the simulated home needs the extra `sim`")
    k = open_source("sim:home?frames=6&size=320x240").camera
    beside = DepthRegistration(FileIntrinsics(k.fx_px, k.fy_px, k.cx_px - 0.5, k.cy_px - 0.5), (-0.05, 0.0, 0.0))
    source = ApartSource(beside)
    source.damaged = 2
    found, why = find_registration(source)
    assert found is not None
    assert found.offset_m == pytest.approx(beside.offset_m, abs=0.006)
    assert "becomes" in why
    source.depth_registered = True
    assert find_registration(source) == (None, "the layout's depth is registered to colour")


@pytest.mark.parametrize(
    ("write", "registered"), [(write_tum, True), (write_replica, True), (write_seven_scenes, False)]
)
def test_layouts_know_whether_their_depth_is_registered(write, registered: bool, tmp_path: Path) -> None:
    source = open_source(str(write(tmp_path / "fr1")))
    assert source.depth_registered is registered
    camera, why = find_registration(source)
    assert camera is None
    assert registered or "expected at least 1000 depth edge points" in why


def test_images_without_depth_edges_are_refused() -> None:
    camera = Camera(50.0, 50.0, 32.0, 24.0, 64, 48)
    wall = Frame(0, 0, np.zeros((48, 64, 3), np.uint8), np.ones((48, 64), np.float32), camera, np.eye(4))
    with pytest.raises(DatasetError, match="expected at least 1000 depth edge points, got 0"):
        align([wall])
    with pytest.raises(DatasetError, match="got 0"):
        align([])
