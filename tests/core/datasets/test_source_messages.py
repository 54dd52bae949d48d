"""Opening a sequence reports excluded frames, unregistered depth and estimates."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import pytest
from tiny_sequences import write_seven_scenes, write_tum

from gausslite.cli.source_options import open_with_warnings, resolve_pose_prior, selected_regions
from gausslite.config.values import AUTO, NONE
from gausslite.datasets.open import open_source
from gausslite.domain.depth_registration import DepthRegistration
from gausslite.domain.pose_exposure_prior import PoseExposurePrior

CAMERA = DepthRegistration.parse("20,20,7.5,5.5,-0.01,0,0")


def test_unregistered_depth_is_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    seven, tum = str(write_seven_scenes(tmp_path / "seq")), str(write_tum(tmp_path / "fr1"))
    assert open_with_warnings(seven, None, None)[1] is None
    [line] = capsys.readouterr().err.splitlines()
    assert line.startswith(
        f"{seven}: this layout does not state whether depth is registered to colour; --register-depth auto "
    )
    for spec, option in ((seven, NONE), (seven, CAMERA), (tum, None)):
        open_with_warnings(spec, None, option)
        assert capsys.readouterr().err == ""


def test_depth_is_registered_to_the_given_camera(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    seven = str(write_seven_scenes(tmp_path / "seq"))
    source, camera = open_with_warnings(seven, None, CAMERA)
    assert camera == CAMERA
    assert source.depth_registered
    assert source.camera == CAMERA.camera(16, 12)
    source, camera = open_with_warnings(seven, None, AUTO)
    assert (camera, source.depth_registered) == (None, False)
    assert "--register-depth none: registration: expected at least 1000 depth edge points" in capsys.readouterr().err


def test_an_estimate_by_default_is_reported_and_made_only_if_necessary(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    seven, tum = str(write_seven_scenes(tmp_path / "seq")), str(write_tum(tmp_path / "fr1"))
    assert open_with_warnings(seven, None, None, AUTO)[1] is None
    notice, result = capsys.readouterr().err.splitlines()
    assert notice.endswith("; the registration is estimated now, --register-depth none uses depth as recorded")
    assert result.startswith("--register-depth none: registration: expected at least 1000 depth edge points")
    assert open_with_warnings(seven, None, CAMERA, AUTO)[1] == CAMERA
    for spec, option in ((seven, NONE), (tum, None)):
        assert open_with_warnings(spec, None, option, AUTO)[1] is None
    assert capsys.readouterr().err == ""


def test_an_estimated_pose_prior_is_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    tum = write_tum(tmp_path / "fr1")
    source = open_source(str(tum))
    given = PoseExposurePrior(0.01, 0.5)
    assert resolve_pose_prior(str(tum), source, given) == given
    assert resolve_pose_prior("sim:home", source, AUTO).is_exact
    assert capsys.readouterr().err == ""
    assert resolve_pose_prior(str(tum), source, AUTO).is_exact
    [line] = capsys.readouterr().err.splitlines()
    assert line == "--pose-prior none: only 0 pairs of frames overlap, too few for an estimate"


def test_skipped_images_are_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write_tum(tmp_path / "fr1", frames=4)
    rows = (folder / "depth.txt").read_text().splitlines()
    (folder / "depth.txt").write_text("\n".join(rows[:3]))
    open_with_warnings(str(folder), None, None)
    [line] = capsys.readouterr().err.splitlines()
    assert line == (f"{folder}: 1 of 4 colour images are skipped: without a pose at their time or depth within 20 ms")


def test_regions_of_the_folder_are_used_with_a_message(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write_tum(tmp_path / "fr1")
    np.savez(folder / "roi_voxels.npz", voxel_size_m=0.02, mug_1=np.zeros((1, 3), np.int32))
    options = argparse.Namespace(source=str(folder), roi=None, objects=("mug_1",), roi_ball=[])
    assert len(selected_regions(options, open_source(str(folder)))) == 1
    [line] = capsys.readouterr().err.splitlines()
    assert line == f"{folder}: the ground-truth regions of roi_voxels.npz in the sequence's folder are used"
