"""The public API: lazy imports, the same maps as the command line, and refused combinations."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from other_process import run_python

import gausslite as gl
from gausslite.cli.main import main
from gausslite.domain.errors import DatasetError, InvalidInputError, MapFileError, PoseError

HOME, FRAMES, SIZE = "sim:home?size=160x120", "0:4", (160, 120)
TASK = "Pick up the mug on the table"


@pytest.fixture(scope="module")
def home() -> gl.Source:
    pytest.importorskip("embreex", reason="simulated homes need the extra sim")
    return gl.open_sequence(HOME)


def test_importing_the_package_loads_nothing_heavy() -> None:
    code = (
        "import sys, gausslite; dir(gausslite); gausslite.GaussLiteError;"
        "print(*[name for name in ('numpy', 'cv2', 'torch', 'grpc', 'gausslite.api') if name in sys.modules])"
    )
    done = run_python("-c", code)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == []


def test_every_public_name_is_importable_and_documented() -> None:
    for name in gl.__all__:
        assert getattr(gl, name).__doc__, name
    assert set(gl.__all__) <= set(dir(gl))
    page = (Path(__file__).parents[3] / "docs" / "reference" / "python.md").read_text()
    assert [name for name in gl.__all__ if not re.search(rf"\b{name}\b", page)] == []
    with pytest.raises(AttributeError, match="no_such_name"):
        _ = gl.no_such_name


def test_the_package_is_typed() -> None:
    assert (Path(gl.__file__).parent / "py.typed").is_file()


@pytest.mark.parametrize("options", [["--task", TASK], []], ids=["task", "uniform"])
def test_maps_have_the_same_bits_as_the_command_line(home: gl.Source, options: list[str], tmp_path: Path) -> None:
    command = ["map", HOME, "--frames", FRAMES, "--size", "160x120", "--out", str(tmp_path / "cli"), *options]
    assert main(command) == 0
    result = gl.map_sequence(home, options[1] if options else None, frames=FRAMES, size=SIZE)
    gl.save_ply(tmp_path / "api.ply", result.gaussians)
    # the headers differ in the comment with the world frame's name
    rows = [
        path.read_bytes().split(b"end_header\n", 1)[1] for path in (tmp_path / "api.ply", tmp_path / "cli" / "map.ply")
    ]
    assert rows[0] == rows[1]
    report = json.loads((tmp_path / "cli" / "report.json").read_text())
    assert {key: report[key] for key in ("frames", "iterations")} == {
        key: result.report[key] for key in ("frames", "iterations")
    }


def test_regions_steer_the_map_like_a_task(home: gl.Source) -> None:
    mug = home.regions()["mug"]
    result = gl.map_sequence(home, regions=[mug], frames=FRAMES, size=SIZE)
    assert 0 < result.gaussians.active.sum() < len(result.gaussians)


def test_live_frames_are_mapped_one_by_one(home: gl.Source) -> None:
    mapper = gl.create_mapper(gl.SceneInfo.of(home), TASK)
    outcomes = [mapper.process(home.frame(i, SIZE)) for i in range(2)]
    assert [outcome.skipped for outcome in outcomes] == [None, None]
    assert len(mapper.gaussians()) == outcomes[-1].gaussians


def test_a_saved_map_is_loaded_and_rendered(home: gl.Source, tmp_path: Path) -> None:
    result = gl.map_sequence(home, frames=FRAMES, size=SIZE, settings=gl.MissionSettings(max_gaussians=5000))
    gl.save_ply(tmp_path / "map.ply", result.gaussians)
    loaded = gl.load_ply(tmp_path / "map.ply")
    np.testing.assert_array_equal(loaded.means_m, result.gaussians.means_m)
    frame = home.frame(2, SIZE)
    image = gl.render_view(loaded, frame.camera, frame.T_world_camera, threads=1)
    assert image.rgb.shape == (120, 160, 3)
    assert image.depth_m.shape == image.alpha.shape == (120, 160)
    assert np.abs(image.rgb - frame.rgb / 255.0).mean() < 0.15
    seen = (frame.depth_m > 0) & (image.depth_m > 0)
    assert np.median(np.abs(image.depth_m - frame.depth_m)[seen]) < 0.1


def test_wrong_arguments_are_named(home: gl.Source, tmp_path: Path) -> None:
    ball, model = gl.BallRegion((0.0, 0.0, 0.0), 1.0), gl.PerceptionSettings(model=tmp_path / "model.onnx")
    pytest.raises(InvalidInputError, gl.map_sequence, home, TASK, regions=[ball]).match("either a task or regions")
    pytest.raises(InvalidInputError, gl.map_sequence, home, perception=model).match("a task for the detector")
    pytest.raises(DatasetError, gl.open_sequence, tmp_path / "missing").match("missing")
    pytest.raises(MapFileError, gl.load_ply, tmp_path / "no.ply").match(r"no\.ply")
    empty, nowhere = gl.Gaussians.empty(), np.zeros((4, 4))
    pytest.raises(PoseError, gl.render_view, empty, home.camera, nowhere).match("T_world_camera")


def test_a_simulated_home_needs_no_calibration(home: gl.Source) -> None:
    calibrated = gl.open_calibrated(HOME)
    assert calibrated.pose_prior.is_exact
    assert calibrated.notes == ()
    assert calibrated.source.depth_registered == home.depth_registered
