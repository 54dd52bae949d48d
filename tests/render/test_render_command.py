"""`gausslite render`: files of poses, images, depth, alpha and video, and what it refuses."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from sample_gaussians import random_gaussians

from gausslite.cli.main import main
from gausslite.codec.ply import write_ply
from gausslite.codec.run_files import KeyframeView, write_keyframe_views
from gausslite.datasets.pose_track import format_pose_rows, quat_xyzw
from gausslite.domain.camera import Camera
from gausslite.domain.pose import inverse, transform_of
from gausslite_render.poses import moved, read_transform, read_views

CAMERA = Camera(50.0, 51.0, 31.0, 25.0, 64, 48)
POSES = [transform_of(np.array([0.1 * i, 0.0, -1.0, 0.05 * i, 0.1 * i, 0.0])) for i in range(3)]


@pytest.fixture
def splats(tmp_path: Path) -> Path:
    write_ply(tmp_path / "map.ply", random_gaussians(50), "", np.full((50, 3, 3), 0.1, np.float32))
    return tmp_path / "map.ply"


def write_poses(folder: Path, form: str) -> Path:
    """Write the same views in a form."""
    if form == "run":
        write_keyframe_views(folder, [KeyframeView(i, i, CAMERA, T, 0) for i, T in enumerate(POSES)])
        return folder
    if form == "tum":
        path = folder / "poses.txt"
        path.write_text(format_pose_rows("poses", np.arange(3) * 10**9, np.array(POSES)))
        return path
    if form == "nerfstudio":
        frames = [
            {"file_path": f"images/a_{i}.jpg", "transform_matrix": (T @ np.diag([1.0, -1.0, -1.0, 1.0])).tolist()}
            for i, T in enumerate(POSES)
        ]
        camera = {"fl_x": 50.0, "fl_y": 51.0, "cx": 31.0, "cy": 25.0, "w": 64, "h": 48, "k1": 0.1}
        path = folder / "transforms.json"
        path.write_text(json.dumps({**camera, "frames": frames}))
        return path
    if form == "3dgs":
        entries = [
            {"id": i, "img_name": f"a_{i}", "width": 64, "height": 48, "fx": 50.0, "fy": 51.0}
            | {"position": T[:3, 3].tolist(), "rotation": T[:3, :3].tolist()}
            for i, T in enumerate(POSES)
        ]
        path = folder / "cameras.json"
        path.write_text(json.dumps(entries))
        return path
    rows = ["# a comment"]
    for i, T in enumerate(map(inverse, POSES)):
        x, y, z, w = quat_xyzw(T[:3, :3])
        rows += [
            f"{i} {w} {x} {y} {z} {' '.join(map(str, T[:3, 3]))} 1 left/a_{i}.png",
            "1.5 2.5 -1 3.5 4.5 7" * (i > 0),
        ]
    (folder / "images.txt").write_text("\n".join(rows) + "\n")
    (folder / "cameras.txt").write_text("1 PINHOLE 64 48 50 51 31 25\n")
    return folder


@pytest.mark.parametrize(
    ("form", "names"),
    [
        ("run", ["000000", "000001", "000002"]),
        ("tum", ["000000", "000001", "000002"]),
        *((form, ["a_0", "a_1", "a_2"]) for form in ("nerfstudio", "3dgs", "colmap")),
    ],
)
def test_all_forms_state_the_same_views(tmp_path: Path, form: str, names: list[str]) -> None:
    views = read_views(write_poses(tmp_path, form))
    assert [view.name for view in views] == names
    for view, T in zip(views, POSES, strict=True):
        np.testing.assert_allclose(view.T_world_camera, T, atol=1e-7)
        centred = Camera(50.0, 51.0, 32.0, 24.0, 64, 48)
        assert view.camera == {"tum": None, "3dgs": centred}.get(form, CAMERA)
        assert view.has_lens == (form == "nerfstudio")


def test_images_depth_alpha_and_video_are_written(
    tmp_path: Path, splats: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    poses, out = write_poses(tmp_path, "nerfstudio"), tmp_path / "out"
    command = [
        "render",
        str(splats),
        "--poses",
        str(poses),
        "--out",
        str(out),
        "--depth",
        "--alpha",
        "--video",
        "--json",
    ]
    assert main(command) == 0
    captured = capsys.readouterr()
    assert json.loads(captured.out) | {"images": 3, "degree": 1, "gaussians": 50} == json.loads(captured.out)
    assert "3 of 3 cameras have lens distortion" in captured.err
    assert "dilated by 0.3 px²" in captured.err
    assert sorted(path.name for path in (out / "rgb").iterdir()) == ["a_0.png", "a_1.png", "a_2.png"]
    depth = cv2.imread(str(out / "depth" / "a_1.png"), cv2.IMREAD_UNCHANGED)
    alpha = cv2.imread(str(out / "alpha" / "a_1.png"), cv2.IMREAD_UNCHANGED)
    assert (depth.dtype, depth.shape, alpha.dtype, alpha.shape) == (np.uint16, (48, 64), np.uint8, (48, 64))
    assert ((depth > 0) <= (alpha >= 127)).all()
    assert 100 < np.median(depth[depth > 0]) < 5000  # millimetres
    assert cv2.VideoCapture(str(out / "video.mp4")).get(cv2.CAP_PROP_FRAME_COUNT) == 3
    assert main(command) == 2
    assert "exists already" in capsys.readouterr().err
    assert main([*command, "--overwrite", "--background", "white", "--size", "32x24"]) == 0
    white, covered = (cv2.imread(str(out / kind / "a_1.png")) for kind in ("rgb", "alpha"))
    assert white.shape == (24, 32, 3)
    assert (white.astype(int) + covered >= 253).all()


def test_depth_beyond_16_bits_is_said(tmp_path: Path, splats: Path, capsys: pytest.CaptureFixture[str]) -> None:
    poses, out = write_poses(tmp_path, "run"), tmp_path / "out"
    command = ["render", str(splats), "--poses", str(poses), "--out", str(out), "--depth", "--depth-units", "1000000"]
    assert main(command) == 0
    assert "images have depth beyond 0.065535, written as 0" in capsys.readouterr().err


def test_poses_of_a_data_set_are_moved_into_nerfstudios_frame(tmp_path: Path) -> None:
    T = transform_of(np.array([1.0, 2.0, 3.0, 0.4, 0.5, 0.6]))
    (tmp_path / "t.json").write_text(json.dumps({"transform": T[:3].tolist(), "scale": 0.5}))
    views = moved(read_views(write_poses(tmp_path, "tum")), *read_transform(tmp_path / "t.json"))
    np.testing.assert_allclose(views[1].T_world_camera[:3, 3], 0.5 * (T @ POSES[1])[:3, 3], atol=1e-6)
    np.testing.assert_allclose(views[1].T_world_camera[:3, :3], (T @ POSES[1])[:3, :3], atol=1e-6)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ((), "3 of 3 poses have no camera; give --camera FILE, or --fov DEG with --size WxH"),
        (("--fov", "60"), "--fov: expected with --size WxH"),
        (("--fov", "60", "--size", "64x48", "--camera", "cameras.txt"), "expected either --camera or --fov"),
        (("--size", "64"), "expected WIDTHxHEIGHT of 16 to 8192 pixels, got '64'"),
        (("--transform", "poses.txt"), 'expected {"transform": 3 x 4 numbers, "scale": a positive number}'),
        (("--poses", "empty.json"), "expected a run's folder, TUM text"),
        (("--poses", "none.json"), "expected poses, got none"),
        (("--poses", "skewed.json"), "expected a rigid pose"),
        (("--poses", "missing.txt"), "expected a text file, got none"),
    ],
)
def test_what_cannot_be_rendered_is_refused_in_one_line(
    tmp_path: Path, splats: Path, options: tuple[str, ...], message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    write_poses(tmp_path, "tum")
    Path("empty.json").write_text("{}")
    Path("none.json").write_text('{"frames": []}')
    Path("skewed.json").write_text(json.dumps({"frames": [{"transform_matrix": (2 * np.eye(4)).tolist()}]}))
    command = ["render", "map.ply", "--out", "out", *(() if "--poses" in options else ("--poses", "poses.txt"))]
    said: list[str] = []
    monkeypatch.setattr("sys.stderr.write", said.append)
    try:
        code = main([*command, *options])
    except SystemExit as stopped:
        code = int(stopped.code or 0)
    assert code == 2
    assert message in "".join(said)
    assert not Path("out").exists()
