"""Exports of the ZED SDK and of Record3D: frames with their poses, cameras and depth; one-line errors."""

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from exported_recordings import home_frames, write_record3d, write_zed, zip_folder

import gausslite as gl
from gausslite.datasets.open import open_source
from gausslite.domain.errors import DatasetError, PoseError
from gausslite.domain.frame import Frame
from gausslite_recorders.record3d import Record3dFiles

BIG_TIME = 1e300
Frames = tuple[Frame, ...]


@pytest.fixture(scope="module")
def frames() -> Frames:
    return home_frames()


@pytest.mark.parametrize("exact_depth", [False, True])
def test_a_zed_export_gives_the_frames_it_was_made_from(tmp_path: Path, frames: Frames, exact_depth: bool) -> None:
    source = open_source(str(write_zed(tmp_path / "zed", frames, exact_depth)))
    assert list(source.indices()) == [frame.index for frame in frames]
    assert source.depth_registered
    for i, expected in enumerate(frames):
        frame = source.frame(i)
        np.testing.assert_array_equal(frame.rgb, expected.rgb)
        np.testing.assert_allclose(frame.depth_m, expected.depth_m, atol=1e-6 if exact_depth else 1.01e-3)
        np.testing.assert_allclose(frame.T_world_camera, expected.T_world_camera, atol=1e-7)
        np.testing.assert_allclose(
            [frame.camera.fx_px, frame.camera.cx_px], [expected.camera.fx_px, expected.camera.cx_px]
        )
        np.testing.assert_allclose(source.trajectory().T_world_camera[i], expected.T_world_camera, atol=1e-7)


def test_zed_frames_without_a_pose_are_excluded_unless_poses_are_tracked(tmp_path: Path, frames: Frames) -> None:
    folder = write_zed(tmp_path / "zed", frames)
    _header, *rows = (folder / "poses.csv").read_text().splitlines()
    (folder / "poses.csv").unlink()
    with pytest.raises(DatasetError, match=r"expected poses.csv or poses.txt with rows of frame tx .*--poses track"):
        open_source(str(folder))
    assert len(open_source(str(folder), require_poses=False)) == len(frames)
    lost = ["1 nan nan nan nan nan nan nan"]
    (folder / "poses.txt").write_text("\n".join([rows[0].replace(",", " "), *lost, *rows[3:]]))
    source = open_source(str(folder))
    assert list(source.indices()) == [0, 3]
    assert source.excluded_frames == "2 of 4 colour images are skipped: without a pose"


@pytest.mark.parametrize("packed", [False, True])
def test_record3d_gives_the_frames_it_was_made_from(tmp_path: Path, frames: Frames, packed: bool) -> None:
    path = write_record3d(tmp_path / "scan", frames)
    if packed:
        path = zip_folder(path, tmp_path / "scan.r3d")
    source = open_source(str(path))
    assert source.name == "scan"
    assert len(source) == len(frames)
    for i, expected in enumerate(frames):
        frame = source.frame(i)
        assert frame.capture_time_ns == round(0.02e9 * i)
        np.testing.assert_allclose(frame.T_world_camera, expected.T_world_camera, atol=1e-7)
        assert frame.camera.fx_px == pytest.approx(expected.camera.fx_px)
        assert frame.camera.cx_px == pytest.approx(expected.camera.cx_px + i / 4)
        # JPEG loses a little
        assert np.abs(frame.rgb.astype(int) - expected.rgb).mean() < 12
        assert (frame.depth_m[:2] == 0).all(), "low confidence"
        assert (frame.depth_m[2:4, :2] == 0).all(), "NaN"
        recorded = expected.depth_m[1::2, 1::2]
        np.testing.assert_array_equal(frame.depth_m[4::2, ::2], recorded[2:])
        np.testing.assert_array_equal(frame.depth_m[5::2, 1::2], recorded[2:])
    assert source.frame(1, (32, 24)).camera.width_px == 32


def test_record3d_without_poses_or_times_is_read_for_tracking(tmp_path: Path, frames: Frames) -> None:
    folder = write_record3d(tmp_path / "scan", frames)
    fields = json.loads((folder / "metadata").read_text())
    for name in ("poses", "frameTimestamps", "perFrameIntrinsicCoeffs"):
        del fields[name]
    (folder / "metadata").write_text(json.dumps(fields))
    (folder / "rgbd" / "0.conf").write_bytes(b"")
    pytest.raises(DatasetError, open_source, str(folder)).match("poses in metadata")
    source = open_source(str(folder), require_poses=False)
    np.testing.assert_array_equal(source.frame(0).T_world_camera, np.eye(4))
    assert (source.frame(0).depth_m[0] > 0).any()
    assert source.frame(3).capture_time_ns == 50_000_000


@pytest.mark.parametrize("kind", ["zed", "record3d"])
def test_exports_can_be_mapped(tmp_path: Path, frames: Frames, kind: str) -> None:
    path = write_zed(tmp_path / "a", frames) if kind == "zed" else write_record3d(tmp_path / "a", frames)
    settings = gl.MissionSettings(max_gaussians=2000, iterations=2)
    assert len(gl.map_sequence(gl.open_sequence(path), settings=settings).gaussians) > 500


def edit_metadata(**changes: object) -> Callable[[Path], None]:
    def edit(folder: Path) -> None:
        fields = json.loads((folder / "metadata").read_text())
        (folder / "metadata").write_text(json.dumps({**fields, **changes}))

    return edit


def write_bytes(name: str, data: bytes) -> Callable[[Path], None]:
    return lambda folder: (folder / name).write_bytes(data) and None


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (write_bytes("metadata", b"{"), "metadata: expected JSON"),
        (write_bytes("metadata", b"[" * 100_000), "metadata: expected JSON"),
        (write_bytes("metadata", b"[]"), "metadata: expected a JSON object, got list"),
        (edit_metadata(K=[1, 2]), r"metadata: K: expected finite numbers of shape \(9,\), got \[1, 2\]"),
        (edit_metadata(K="9"), "metadata: K: expected finite numbers"),
        (edit_metadata(w=None), "metadata: w: expected finite numbers"),
        (edit_metadata(w=10**9, h=10**9), "metadata: w, h: expected an image of 1 to"),
        (edit_metadata(poses=[[0, 0, 0, 1, 0, 0]] * 4), "metadata: poses: expected finite numbers of shape"),
        (edit_metadata(poses=[[0, 0, 0, 3, 0, 0, 0]] * 4), "poses 0: expected a quaternion of length 1"),
        (edit_metadata(poses=[[0, 0, 0, "x", 0, 0, 0]] * 4), "metadata: poses: expected finite numbers"),
        (edit_metadata(frameTimestamps=[2, 1, 0, 3]), "frameTimestamps: expected ascending times"),
        (edit_metadata(frameTimestamps=[0, 1, 2, BIG_TIME]), "frameTimestamps: expected ascending times"),
        (edit_metadata(fps=0), "fps: expected a positive number"),
        (edit_metadata(dw=31), r"0.depth: expected 2976 bytes, compressed with LZFSE, got 3072 bytes"),
        (edit_metadata(w=62), "0.jpg: expected the size in metadata, 62x48, got 64x48"),
        (write_bytes("rgbd/0.depth", b"abc"), "0.depth: expected 3072 bytes.* got bytes of another format"),
        (write_bytes("rgbd/0.jpg", b"abc"), "0.jpg: expected a PNG or JPEG image, got another format"),
    ],
)
def test_a_damaged_record3d_recording_gives_one_line(
    tmp_path: Path, frames: Frames, damage: Callable[[Path], None], message: str
) -> None:
    folder = write_record3d(tmp_path / "scan", frames)
    damage(folder)
    with pytest.raises((DatasetError, PoseError), match=message) as raised:
        open_source(str(folder)).frame(0)
    assert "\n" not in str(raised.value)


def test_a_depth_file_that_declares_gigabytes_is_refused_before_it_is_decompressed(
    tmp_path: Path, frames: Frames
) -> None:
    folder = write_record3d(tmp_path / "scan", frames)
    data = bytearray((folder / "rgbd" / "0.depth").read_bytes())
    data[4:8] = (0xFFFFFFFF).to_bytes(4, "little")
    (folder / "rgbd" / "0.depth").write_bytes(data)
    with pytest.raises(DatasetError, match=r"0.depth: expected 3072 bytes"):
        Record3dFiles(folder).read_array("rgbd/0.depth", np.float32, 32 * 24)


def test_an_r3d_file_that_is_no_zip_gives_one_line(tmp_path: Path) -> None:
    (tmp_path / "scan.r3d").write_bytes(b"PK not a zip")
    with pytest.raises(DatasetError, match=r"scan.r3d: expected an .r3d file, which is a ZIP"):
        open_source(str(tmp_path / "scan.r3d"))


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda folder: (folder / "cam_params.json").unlink(), "camera is unknown: expected cam_params.json"),
        (write_bytes("poses.csv", b"0 1 2 3"), r"poses.csv line 1: expected 8 numbers \(frame tx"),
        (write_bytes("poses.csv", b"1.5 0 0 0 0 0 0 1"), "expected a frame's number"),
        (write_bytes("poses.csv", b"0 0 0 0 0 0 0 3"), "line 1: expected a quaternion of length 1"),
        (lambda folder: (folder / "depth000000.png").unlink(), "depth000000.png: expected an image, got none"),
        (write_bytes("depth000000.npy", b"abc"), "depth000000.npy: expected a .npy file"),
        (
            lambda folder: np.save(folder / "depth000000.npy", np.zeros((48, 64))),
            r"expected a float32 image of one channel, got float64 of shape \(48, 64\)",
        ),
        (
            lambda folder: cv2.imwrite(str(folder / "depth000000.png"), np.zeros((48, 64, 4), np.uint8)),
            "depth000000.png: expected a 16-bit image of one channel",
        ),
    ],
)
def test_a_damaged_zed_export_gives_one_line(
    tmp_path: Path, frames: Frames, damage: Callable[[Path], None], message: str
) -> None:
    folder = write_zed(tmp_path / "zed", frames)
    damage(folder)
    with pytest.raises((DatasetError, PoseError), match=message) as raised:
        open_source(str(folder)).frame(0)
    assert "\n" not in str(raised.value)
