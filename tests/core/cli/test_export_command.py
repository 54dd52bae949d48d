"""`gausslite export` over a results folder that `gausslite map` wrote."""

import json
import shutil

import pytest

from gausslite.cli.main import main
from gausslite.codec.keyframe_views import read_keyframe_views


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    folder = tmp_path_factory.mktemp("export") / "run"
    arguments = ["map", "sim:home", "--task", "Pick up the mug on the table", "--size", "160x120", "--frames", "0:12"]
    assert main([*arguments, "--iterations", "2", "--out", str(folder)]) == 0
    return folder


def test_map_writes_the_cameras_of_its_keyframes(results):
    views = read_keyframe_views(results)
    assert views
    assert [view.index for view in views] == sorted(view.index for view in views)
    assert (views[0].camera.width_px, views[0].camera.height_px) == (160, 120)


OPTIONS = {
    **dict.fromkeys(("octomap", "nav2", "mesh"), ("--voxel", "0.1")),
    "video": ("--seconds", "0.2"),
}


@pytest.mark.parametrize(
    "name", ["ply", "spz", "splat", "gltf", "pcd", "las", "octomap", "nav2", "mesh", "video", "json"]
)
def test_every_format_writes_its_default_file(results, name, capsys):
    command = ["export", str(results), "--to", name, "--region", "all", *OPTIONS.get(name, ())]
    assert main([*command, "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert (report["format"], report["gaussians"] > 0, report["bytes"] > 0) == (name, True, True)
    assert main(command) == 2
    assert "--overwrite" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("option", "message"),
    [
        (("--voxel", "0.1"), "--voxel: expected with --to octomap or nav2 or mesh, got --to spz"),
        (("--min-opacity", "0.1"), "--min-opacity: expected with --to octomap or nav2, got --to spz"),
        (("--seconds", "3"), "--seconds: expected with --to video, got --to spz"),
    ],
)
def test_an_option_without_effect_is_refused(results, capsys, option, message):
    assert main(["export", str(results), "--to", "spz", *option]) == 2
    assert message in capsys.readouterr().err


def test_the_map_itself_is_never_the_output(results, capsys):
    before = (results / "map.ply").read_bytes()
    out = str(results / "map.ply")
    assert main(["export", str(results), "--to", "ply", "--out", out, "--overwrite"]) == 2
    assert "not the input" in capsys.readouterr().err
    assert (results / "map.ply").read_bytes() == before


def test_a_missing_run_is_one_line(tmp_path, capsys):
    assert main(["export", str(tmp_path / "nothing"), "--to", "spz"]) == 2
    assert "map.ply" in capsys.readouterr().err


def test_the_objects_of_a_damaged_report_are_not_exported_as_none(results, tmp_path, capsys):
    shutil.copy(results / "map.ply", tmp_path)
    (tmp_path / "report.json").write_text("{")
    assert main(["export", str(tmp_path), "--to", "json", "--region", "all"]) == 2
    assert "report.json: expected the report of a run" in capsys.readouterr().err
    assert not (tmp_path / "map.json").exists()
