"""Recordings open, and are used as they are, without the packages that read and calibrate other ones."""

from pathlib import Path

import numpy as np
import pytest
from absent_package import remove_package
from tiny_sequences import write_seven_scenes, write_tum

import gausslite as gl
from gausslite.cli.main import main
from gausslite.config.values import AUTO
from gausslite.datasets.calibration import StatedValues, open_calibrator
from gausslite.datasets.open import open_source
from gausslite.domain.errors import DatasetError, MissingPluginError
from gausslite.domain.lens import Lens
from gausslite.domain.recording import CameraCorrection, DepthRegistration, PoseExposurePrior
from gausslite.mission.recording import calibrate_with_messages, stated_values
from gausslite.mission.runner import FrameStream
from gausslite.mission.settings import SourceSettings

READERS = ("gausslite_ros", "gausslite_recorders", "gausslite_sim")
ABSENT = "needs the package gausslite_calibration, which is not installed"


def test_folders_open_without_the_packages_of_other_readers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tum, inside = write_tum(tmp_path / "fr1"), write_tum(tmp_path / "parent" / "fr1_seq")
    seven = write_seven_scenes(tmp_path / "seven")
    for package in READERS:
        remove_package(monkeypatch, package)
    assert open_source(str(tum)).name == "fr1"
    assert open_source(str(inside.parent)).name == "fr1_seq"
    pytest.raises(DatasetError, open_source, str(seven)).match("sevenscenes: needs the package gausslite_recorders")


@pytest.mark.parametrize(
    ("address", "package"),
    [("sim:home", "gausslite_sim"), ("bag:run.mcap", "gausslite_ros"), ("zed:export", "gausslite_recorders")],
)
def test_an_address_of_an_absent_package_names_it(
    address: str, package: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    remove_package(monkeypatch, package)
    with pytest.raises(MissingPluginError, match=f"needs the package {package}, which is not installed"):
        open_source(address)
    assert main(["map", address, "--out", str(tmp_path / "out")]) == 2
    assert f"the package {package}, which is not installed" in capsys.readouterr().err.splitlines()[-1]


def test_an_unknown_address_names_what_is_installed_and_what_is_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(DatasetError, match=r"a ROS bag, an .r3d file or sim:home; got nothing there$"):
        open_source(str(tmp_path / "none"))
    (tmp_path / "other" / "folder").mkdir(parents=True)
    with pytest.raises(DatasetError, match=r"expected TUM .*, Record3D .* or ZED \(left000000.png, depth000000.png\)$"):
        open_source(str(tmp_path / "other"))
    remove_package(monkeypatch, "gausslite_ros")
    (tmp_path / "run.mcap").touch()
    with pytest.raises(
        DatasetError, match=r"an .r3d file or sim:home; got an empty file; bag: needs the package gausslite_ros"
    ):
        open_source(str(tmp_path / "run.mcap"))


def test_a_reader_opens_what_follows_its_name(tmp_path: Path) -> None:
    pytest.importorskip("rosbags", reason="bags need the extra ros")
    with pytest.raises(DatasetError, match=r"none\.mcap: expected a bag: .* got nothing there"):
        open_source(f"bag:{tmp_path / 'none.mcap'}")


def test_stated_values_are_used_without_a_calibrator(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    source = open_source(str(write_seven_scenes(tmp_path / "seq")))
    prior = PoseExposurePrior(0.01, 0.5)
    stated = StatedValues.all_of(None, CameraCorrection(), prior)
    expected = open_calibrator().calibrate(source, stated)
    remove_package(monkeypatch, "gausslite_calibration")
    found = calibrate_with_messages("seq", source, stated)
    assert (found.registration, found.correction, found.pose_prior) == (None, CameraCorrection(), prior)
    frame, other = found.source.frame(1), expected.source.frame(1)
    np.testing.assert_array_equal(frame.depth_m, other.depth_m)
    assert (frame.camera, frame.motion) == (other.camera, other.motion)
    assert capsys.readouterr().err == ""


def test_a_registration_and_a_correction_name_their_absent_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, camera = write_seven_scenes(tmp_path / "seq"), DepthRegistration.parse("20,20,7.5,5.5,-0.01,0,0")
    frame = open_source(str(folder)).frame(0)
    remove_package(monkeypatch, "gausslite_calibration")
    with pytest.raises(MissingPluginError, match=f"register-depth: {ABSENT}"):
        open_source(str(folder), depth_registration=camera)
    with pytest.raises(MissingPluginError, match=f"camera-correction: {ABSENT}"):
        FrameStream.open(SourceSettings(str(folder), camera_correction=CameraCorrection(readout_s=0.01)))
    assert open_calibrator().live_frame(frame, None) is frame
    with pytest.raises(MissingPluginError, match=f"lens of a frame: {ABSENT}"):
        open_calibrator().live_frame(frame, Lens.parse("radtan:0.1,0,0,0"))


def test_a_lens_of_the_files_stays_in_the_images_without_the_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = write_tum(tmp_path / "fr1")
    recorded, corrected = open_source(str(folder)), FrameStream.open(SourceSettings(str(folder))).source
    remove_package(monkeypatch, "gausslite_calibration")
    found = FrameStream.open(SourceSettings(str(folder))).source
    assert found.frame(0).rgb.tobytes() == recorded.frame(0).rgb.tobytes()
    assert (found.lens, corrected.lens) == (recorded.lens, None)
    note = gl.open_calibrated(folder).notes[-1]
    assert note == f"not corrected: the lens {found.lens}; gausslite.calibrators: {ABSENT}"


def test_one_line_says_what_is_not_estimated_without_a_calibrator(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = write_seven_scenes(tmp_path / "seq")
    remove_package(monkeypatch, "gausslite_calibration")
    found = calibrate_with_messages(str(folder), open_source(str(folder)), stated_values(AUTO, None, AUTO))
    assert (found.registration, found.correction.is_identity, found.pose_prior.is_exact) == (None, True, True)
    [line] = capsys.readouterr().err.splitlines()
    assert line.startswith(f"{folder}: not estimated: registration of depth, lens, shutter, errors of the poses; ")
    assert line.endswith(ABSENT)
    assert gl.open_calibrated(folder).notes == found.notes


def test_an_exact_home_needs_no_calibrator(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("embreex", reason="the simulated home needs the extra `sim`")
    remove_package(monkeypatch, "gausslite_calibration")
    assert gl.open_calibrated("sim:home?frames=2&size=64x48").notes == ()


def test_the_command_that_calibrates_names_its_package(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    remove_package(monkeypatch, "gausslite_calibration")
    assert main(["calibrate", "sim:home"]) == 2
    assert ABSENT in capsys.readouterr().err.splitlines()[-1]
