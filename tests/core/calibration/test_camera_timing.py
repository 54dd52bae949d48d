"""Readout time and time offset of simulated cameras with a known truth."""

from __future__ import annotations

import pytest

from gausslite.calibration.camera_timing import estimate_camera_timing
from gausslite.datasets.open import open_source
from gausslite.domain.camera_correction import CameraCorrection

pytest.importorskip("embreex", reason="the simulated home needs the extra `sim`")

HOME = "sim:home-1?frames=90&size=160x120&noise=0&exposure=0"


def test_the_readout_time_of_a_turning_camera_is_estimated() -> None:
    found, evidence = estimate_camera_timing(open_source(f"{HOME}&speed=60&shutter=30ms"), CameraCorrection())
    assert found.readout_s == pytest.approx(0.03, abs=0.003)
    assert abs(found.time_offset_s) <= 0.003
    assert "rotation error" in evidence


def test_a_global_shutter_is_left_alone() -> None:
    found, evidence = estimate_camera_timing(open_source(f"{HOME}&speed=60"), CameraCorrection())
    assert found.is_identity
    assert "not used" in evidence


def test_a_slow_camera_gives_no_estimate() -> None:
    found, evidence = estimate_camera_timing(open_source(f"{HOME}&speed=2&shutter=30ms"), CameraCorrection())
    assert found.is_identity
    assert "turn fast enough" in evidence
