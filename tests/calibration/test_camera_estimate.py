"""Lens, readout time, time offset and exposure time of simulated cameras with a known truth."""

import math
from pathlib import Path

import cv2
import numpy as np
import pytest
from tool_modules import load_tool
from tum_recording import write_home

from gausslite.datasets.open import open_source
from gausslite.domain.lens import Lens, LensModel
from gausslite.domain.recording import CameraCorrection
from gausslite_calibration.camera_estimate import estimate_camera, minimum
from gausslite_calibration.exposure_time import estimate_exposure_time

pytest.importorskip("embreex", reason="the simulated home needs the extra `sim`")

HOME = "sim:home-1?frames=90&size=160x120&noise=0&exposure=0"
PINHOLE = Lens(LensModel.RADTAN, (0.0, 0.0, 0.0, 0.0))


@pytest.mark.slow
def test_lens_and_readout_of_a_turning_camera_are_estimated() -> None:
    source = open_source(f"{HOME}&speed=60&shutter=30ms&lens=radtan:-0.2,0,0,0")
    estimate = estimate_camera(source, CameraCorrection())
    found = estimate.correction
    assert found.readout_s == pytest.approx(0.03, abs=0.003)
    assert abs(found.time_offset_s) <= 0.003
    assert found.lens is not None
    k1, k2 = found.lens.coefficients[:2]
    # distortion at a typical distance from the centre, half of the image's width
    assert k1 + 0.35 * k2 == pytest.approx(-0.2, abs=0.02)
    assert [line.partition(":")[0] for line in estimate.evidence] == ["lens", "readout and offset", "exposure"]


@pytest.mark.slow
def test_the_exposure_time_is_estimated_from_blur() -> None:
    spec = "sim:home-1?frames=90&size=240x180&exposure=0&speed=60&blur=10ms"
    exposure_s, evidence = estimate_exposure_time(open_source(spec), CameraCorrection())
    assert exposure_s == pytest.approx(0.01, abs=0.001)
    assert "pairs of a fast and a slower frame" in evidence


@pytest.mark.slow
def test_an_ideal_camera_is_left_alone() -> None:
    estimate = estimate_camera(open_source(f"{HOME}&speed=60"), CameraCorrection())
    assert estimate.correction.is_identity
    assert all("not used" in line or "expected at least" in line for line in estimate.evidence), estimate.evidence


@pytest.mark.slow
@pytest.mark.parametrize("readout_ms", [0, 30])
def test_drifting_poses_neither_hide_nor_feign_a_readout_time_and_a_known_lens_is_kept(
    tmp_path: Path, readout_ms: int
) -> None:
    shutter = f"&shutter={readout_ms}ms" if readout_ms else ""
    home = f"sim:home-1?frames=60&size=160x120&noise=0&exposure=0&speed=60{shutter}"
    # 2 degrees: more than the shutter turns any pair of frames
    load_tool("write_recording").write_recording(home, "", tmp_path / "recording", 0.015, 2.0, 5)
    estimate = estimate_camera(open_source(str(tmp_path / "recording")), CameraCorrection(PINHOLE))
    assert estimate.correction.readout_s == pytest.approx(1e-3 * readout_ms, abs=0.003), estimate.evidence
    assert ("not used" in estimate.evidence[0]) == (readout_ms == 0)
    assert len(estimate.evidence) == 2
    assert estimate.correction.lens == PINHOLE


def test_times_are_not_estimated_from_a_few_tiny_frames(tmp_path: Path) -> None:
    correction = estimate_camera(open_source(str(write_home(tmp_path / "recording"))), CameraCorrection()).correction
    assert (correction.readout_s, correction.time_offset_s, correction.exposure_s) == (0.0, 0.0, 0.0)


def test_black_images_give_no_estimate(tmp_path: Path) -> None:
    folder = write_home(tmp_path / "recording", frames=30)
    for path in folder.glob("rgb-*.png"):
        cv2.imwrite(str(path), np.zeros_like(cv2.imread(str(path))))
    estimate = estimate_camera(open_source(str(folder)), CameraCorrection())
    assert estimate.correction.is_identity
    assert estimate.evidence == ("0 pairs of frames can be compared, expected at least 4",)


@pytest.mark.slow
def test_no_lens_is_estimated_from_tiny_images() -> None:
    home = "sim:home-1?frames=40&size=96x72&noise=0&exposure=0&speed=60&lens=radtan:-0.2,0,0,0"
    estimate = estimate_camera(open_source(home), CameraCorrection())
    assert estimate.correction.lens is None
    assert "expected at least 160x120" in estimate.evidence[0]


@pytest.mark.parametrize("costs", [(math.inf, 1.0, math.inf), (math.inf, 1.0, 2.0), (math.inf, math.inf, math.inf)])
def test_values_at_which_nothing_could_be_compared_are_not_interpolated(costs: tuple[float, ...]) -> None:
    values = (-1.0, 0.0, 1.0)
    assert minimum(values, dict(zip(values, costs, strict=True)).__getitem__) == values[costs.index(min(costs))]
