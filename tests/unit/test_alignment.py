"""The colour camera is found again where it is known: the simulated home seen by a depth camera set beside it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gausslite.datasets.alignment import align
from gausslite.datasets.intrinsics import FileIntrinsics
from gausslite.datasets.open import open_source
from gausslite.datasets.registration import ColourCamera, register_depth
from gausslite.domain.camera import Camera
from gausslite.domain.frame import Frame
from gausslite.domain.pose import inverse
from gausslite.errors import DatasetError

DEPTH_CAMERA = Camera(300.0, 300.0, 162.0, 118.5, 320, 240)


def unregister(frame: Frame, T_colour_depth: np.ndarray) -> Frame:
    """The same colour, with the depth a camera beside it would have measured."""
    depth_m = register_depth(frame.depth_m, frame.camera, DEPTH_CAMERA, inverse(T_colour_depth))
    return replace(frame, depth_m=depth_m, camera=DEPTH_CAMERA)


def test_a_known_colour_camera_is_found() -> None:
    pytest.importorskip("embreex", reason="the simulated home needs the extra `sim`")
    home = open_source("sim:home?seed=0&trajectory=0&frames=6&size=320x240&noise=0")
    frames = [home.frame(i) for i in range(len(home))]
    k = home.camera
    intrinsics = FileIntrinsics(k.fx_px, k.fy_px, k.cx_px - 0.5, k.cy_px - 0.5)
    truth = ColourCamera(intrinsics, (-0.03, 0.01, 0.0), (0.0, 0.0, 0.8))
    found = align([unregister(frame, truth.depth_to_colour()) for frame in frames])
    assert found.score > 1.2 * found.score_before
    assert found.camera.intrinsics.fx == pytest.approx(truth.intrinsics.fx, rel=0.01)
    assert found.camera.offset_m == pytest.approx(truth.offset_m, abs=0.004)
    assert found.camera.turn_deg == pytest.approx(truth.turn_deg, abs=0.15)
    assert found.camera.intrinsics.cx == pytest.approx(truth.intrinsics.cx, abs=1.0)
    assert found.camera.intrinsics.cy == pytest.approx(truth.intrinsics.cy, abs=1.0)


def test_images_without_depth_edges_are_refused() -> None:
    camera = Camera(50.0, 50.0, 32.0, 24.0, 64, 48)
    wall = Frame(0, 0, np.zeros((48, 64, 3), np.uint8), np.ones((48, 64), np.float32), camera, np.eye(4))
    with pytest.raises(DatasetError, match="expected at least 1000 depth edge points, got 0"):
        align([wall])
    with pytest.raises(DatasetError, match="got 0"):
        align([])
