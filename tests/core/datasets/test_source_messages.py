"""What a user would not expect of a sequence is told when it is opened: images left out, depth nobody registered."""

from __future__ import annotations

from pathlib import Path

import pytest
from tiny_sequences import write_seven_scenes, write_tum

from gausslite.calibration.pose_exposure_prior import PoseExposurePrior
from gausslite.cli.source_options import open_with_warnings, resolve_pose_prior
from gausslite.config.values import AUTO, NONE
from gausslite.datasets.open import open_source
from gausslite.datasets.registered_source import DepthRegistration

CAMERA = DepthRegistration.parse("20,20,7.5,5.5,-0.01,0,0")


def test_depth_that_nobody_registered_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    seven, tum = str(write_seven_scenes(tmp_path / "seq")), str(write_tum(tmp_path / "fr1"))
    assert open_with_warnings(seven, None, None)[1] is None
    [line] = capsys.readouterr().err.splitlines()
    assert line.startswith(
        f"{seven}: its layout leaves open whether depth is registered to colour; --register-depth auto "
    )
    for spec, asked in ((seven, NONE), (seven, CAMERA), (tum, None)):
        open_with_warnings(spec, None, asked)
        assert capsys.readouterr().err == ""


def test_depth_is_registered_as_asked(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    seven = str(write_seven_scenes(tmp_path / "seq"))
    source, camera = open_with_warnings(seven, None, CAMERA)
    assert camera == CAMERA
    assert source.depth_registered
    assert source.camera == CAMERA.camera(16, 12)
    source, camera = open_with_warnings(seven, None, AUTO)
    assert (camera, source.depth_registered) == (None, False)
    assert "--register-depth none: alignment: expected at least 1000 depth edge points" in capsys.readouterr().err


def test_a_program_that_looks_by_default_says_so_and_only_where_it_has_to(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    seven, tum = str(write_seven_scenes(tmp_path / "seq")), str(write_tum(tmp_path / "fr1"))
    assert open_with_warnings(seven, None, None, AUTO)[1] is None
    looking, found = capsys.readouterr().err.splitlines()
    assert looking.endswith("; looking for its colour camera now, --register-depth none takes it as it is")
    assert found.startswith("--register-depth none: alignment: expected at least 1000 depth edge points")
    assert open_with_warnings(seven, None, CAMERA, AUTO)[1] == CAMERA
    for spec, asked in ((seven, NONE), (tum, None)):
        assert open_with_warnings(spec, None, asked, AUTO)[1] is None
    assert capsys.readouterr().err == ""


def test_what_is_believed_of_views_is_told_where_it_was_measured(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    tum = write_tum(tmp_path / "fr1")
    source = open_source(str(tum))
    said = PoseExposurePrior(0.01, 0.5)
    assert resolve_pose_prior(str(tum), source, said) == said
    assert resolve_pose_prior("sim:home", source, AUTO).is_exact
    assert capsys.readouterr().err == ""
    assert resolve_pose_prior(str(tum), source, AUTO).is_exact
    [line] = capsys.readouterr().err.splitlines()
    assert line == "--pose-prior none: 0 pairs of its frames can be compared, too few to tell"


def test_images_that_are_left_out_are_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write_tum(tmp_path / "fr1", frames=4)
    rows = (folder / "depth.txt").read_text().splitlines()
    (folder / "depth.txt").write_text("\n".join(rows[:3]))
    open_with_warnings(str(folder), None, None)
    [line] = capsys.readouterr().err.splitlines()
    assert line == (f"{folder}: 1 of 4 colour images are left out, without a pose at their time or depth within 20 ms")
