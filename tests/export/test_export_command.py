"""`gausslite export` over a results folder that `gausslite map` wrote."""

import json
import shutil
from importlib.util import find_spec

import numpy as np
import pytest
from plugin_entries import register

from gausslite.cli.main import main
from gausslite.codec.ply import read_ply, write_ply
from gausslite.codec.run_files import read_keyframe_views
from gausslite.domain.gaussians import Gaussians
from gausslite.plugins import Group, installed
from gausslite_export.format import Format


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    folder = tmp_path_factory.mktemp("export") / "run"
    arguments = ["map", "sim:home?frames=8&size=160x120", "--task", "Pick up the mug on the table"]
    assert main([*arguments, "--iterations", "2", "--out", str(folder)]) == 0
    return folder


def test_map_writes_the_cameras_of_its_keyframes(results):
    views = read_keyframe_views(results)
    assert views
    assert [view.index for view in views] == sorted(view.index for view in views)
    assert (views[0].camera.width_px, views[0].camera.height_px) == (160, 120)


OPTIONS = {
    **dict.fromkeys(("octomap", "nav2", "esdf", "mesh"), ("--voxel", "0.1")),
    "video": ("--seconds", "0.2"),
}


FORMATS = {name: chosen for name, chosen in installed(Group.EXPORTERS) if name != "rrd" or find_spec("rerun")}


def run_with_map(results, folder, gaussians):
    """Write a results folder with this map and the keyframes of a real run."""
    folder.mkdir()
    for name in ("keyframes.json", "report.json"):
        shutil.copy(results / name, folder)
    write_ply(folder / "map.ply", gaussians)
    return folder


def test_an_empty_map_and_one_of_nan_are_refused_by_every_format(results, tmp_path, capsys):
    gaussians = read_ply(results / "map.ply")
    gaussians.means_m[:, 1] = np.nan
    empty = run_with_map(results, tmp_path / "empty", Gaussians.empty())
    not_finite = run_with_map(results, tmp_path / "nan", gaussians)
    for name in FORMATS:
        for run, message in (
            (empty, "expected a map with at least one Gaussian, got an empty map"),
            (not_finite, "column y: expected finite values"),
        ):
            assert main(["export", str(run), "--to", name, "--region", "all"]) == 2
            (line,) = capsys.readouterr().err.splitlines()
            assert message in line
            assert {file.name for file in run.iterdir()} == {"map.ply", "keyframes.json", "report.json"}


@pytest.mark.parametrize("name", FORMATS)
def test_gaussians_far_outside_are_left_out_with_one_line(results, tmp_path, name, capsys):
    gaussians = read_ply(results / "map.ply")
    gaussians.means_m[3, 1] = gaussians.scales_m[4, 1] = 1e30
    run = run_with_map(results, tmp_path / "far", gaussians)
    assert main(["export", str(run), "--to", name, "--region", "all", "--json", *OPTIONS.get(name, ())]) == 0
    captured = capsys.readouterr()
    report = json.loads(captured.out)
    assert (report["gaussians"], report["left_out"]) == (len(gaussians) - 2, 2)
    notes = [line for line in captured.err.splitlines() if "left out" in line]
    assert notes == [
        f"left out 2 of {len(gaussians)} Gaussians: expected coordinates and standard deviations up to "
        f"{FORMATS[name].max_extent_m:g} m, got larger ones"
    ]


@pytest.mark.parametrize("name", FORMATS)
def test_a_gaussian_of_nan_is_left_out_with_one_line(results, tmp_path, name, capsys):
    gaussians = read_ply(results / "map.ply")
    gaussians.means_m[3, 1] = np.nan
    run = run_with_map(results, tmp_path / "nan", gaussians)
    assert main(["export", str(run), "--to", name, "--region", "all", "--json", *OPTIONS.get(name, ())]) == 0
    captured = capsys.readouterr()
    assert (json.loads(captured.out)["left_out"], np.isnan(gaussians.means_m).sum()) == (1, 1)
    notes = [line for line in captured.err.splitlines() if "left out" in line]
    assert notes == [f"left out 1 of {len(gaussians)} Gaussians: column y: expected finite values, got NaN or infinity"]


@pytest.mark.parametrize("name", FORMATS)
def test_the_suffix_of_another_format_is_refused(results, tmp_path, name, capsys):
    for suffix in (".ply", ".gltf", ".pgm", ".txt", ""):
        out = tmp_path / f"map{suffix}"
        if FORMATS[name].suffix.endswith(suffix or "."):
            continue
        assert main(["export", str(results), "--to", name, "--region", "all", "--out", str(out)]) == 2
        assert f"{out}: expected a name with the suffix" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_the_image_of_a_grid_replaces_no_file_without_overwrite(results, tmp_path, capsys):
    image = tmp_path / "plan.pgm"
    image.write_text("a floor plan")
    for suffix in (".yaml", ".yml", ".YAML"):
        command = ["export", str(results), "--to", "nav2", "--voxel", "0.1", "--out", str(tmp_path / f"plan{suffix}")]
        assert main(command) == 2
        assert f"{image} exists already" in capsys.readouterr().err
        assert [file.name for file in tmp_path.iterdir()] == ["plan.pgm"]
    assert image.read_text() == "a floor plan"
    assert main([*command, "--overwrite"]) == 0
    assert image.read_bytes()[:2] == b"P5"


@pytest.mark.parametrize("name", FORMATS)
def test_one_gaussian_is_exported_unless_it_has_no_surface(results, tmp_path, name, capsys):
    gaussians = read_ply(results / "map.ply")
    run = run_with_map(results, tmp_path / "one", gaussians.take(np.flatnonzero(gaussians.opacities > 0.5)[:1]))
    code = main(["export", str(run), "--to", name, "--region", "all", *OPTIONS.get(name, ())])
    captured = capsys.readouterr()
    if name == "mesh":
        assert (code, captured.out) == (2, "")
        assert "mesh: expected a surface that the keyframes show" in captured.err
    else:
        assert (code, captured.out[:13]) == (0, "1 Gaussians o")


@pytest.mark.parametrize("name", FORMATS)
def test_every_format_writes_its_default_file(results, name, capsys):
    command = ["export", str(results), "--to", name, "--region", "all", *OPTIONS.get(name, ())]
    assert main([*command, "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert (report["format"], report["gaussians"] > 0, report["bytes"] > 0) == (name, True, True)
    assert main(command) == 2
    assert "--overwrite" in capsys.readouterr().err


def test_the_map_itself_is_never_the_output(results, capsys):
    before = (results / "map.ply").read_bytes()
    out = str(results / "map.ply")
    assert main(["export", str(results), "--to", "ply", "--out", out, "--overwrite"]) == 2
    assert "not the input" in capsys.readouterr().err
    assert (results / "map.ply").read_bytes() == before


def test_the_objects_of_a_damaged_report_are_not_exported_as_none(results, tmp_path, capsys):
    shutil.copy(results / "map.ply", tmp_path)
    (tmp_path / "report.json").write_text("{")
    assert main(["export", str(tmp_path), "--to", "json", "--region", "all"]) == 2
    assert "report.json: expected the report of a run" in capsys.readouterr().err
    assert not (tmp_path / "map.json").exists()


@pytest.mark.parametrize(
    ("option", "message"),
    [
        (("--voxel", "0.1"), "--voxel: expected with --to esdf or mesh or nav2 or octomap, got --to spz"),
        (("--min-opacity", "0.1"), "--min-opacity: expected with --to esdf or nav2 or octomap, got --to spz"),
        (("--seconds", "3"), "--seconds: expected with --to video, got --to spz"),
        (("--to", "sog", "--spz-version", "4"), "--spz-version: expected with --to spz, got --to sog"),
    ],
)
def test_an_option_without_effect_is_refused(results, capsys, option, message):
    assert main(["export", str(results), "--to", "spz", *option]) == 2
    assert message in capsys.readouterr().err


def test_a_missing_run_and_a_map_far_outside_as_a_whole_are_refused(results, tmp_path, capsys):
    assert main(["export", str(tmp_path / "nothing"), "--to", "spz"]) == 2
    assert "map.ply" in capsys.readouterr().err
    gaussians = read_ply(results / "map.ply")
    gaussians.means_m[:] = 1e30
    run = run_with_map(results, tmp_path / "far", gaussians)
    assert main(["export", str(run), "--to", "nav2"]) == 2
    assert "expected Gaussians within 100000 m of the origin, got none" in capsys.readouterr().err


def test_a_file_of_another_tool_is_converted_and_spz_states_its_version(results, tmp_path, capsys):
    before = read_ply(results / "map.ply")
    for out, options in (("a.sog", ("sog",)), ("b.spz", ("spz", "--spz-version", "4")), ("c.ply", ("ply",))):
        source = {"a.sog": results, "b.spz": tmp_path / "a.sog", "c.ply": tmp_path / "b.spz"}[out]
        assert main(["export", str(source), "--to", *options, "--out", str(tmp_path / out)]) == 0
        assert ("SPZ version 4" in capsys.readouterr().err) == (out == "b.spz")
    assert (tmp_path / "b.spz").read_bytes()[:8] == b"NGSP\x04\0\0\0"
    after = read_ply(tmp_path / "c.ply")
    np.testing.assert_allclose(after.means_m.mean(axis=0), before.means_m.mean(axis=0), atol=1e-3)
    np.testing.assert_allclose(after.rgb.mean(axis=0), before.rgb.mean(axis=0), atol=0.01)


def write_points(path, content, _settings):
    np.savetxt(path, content.chosen.means_m)


POINTS = Format(".xyz", "points as text", write_points, uses=("voxel",))


def test_a_format_of_another_package_is_listed_and_written(results, tmp_path, capsys, monkeypatch):
    theirs, ours = f"{__name__}:POINTS", "gausslite_export.formats"
    register(monkeypatch, Group.EXPORTERS, points=theirs, mesh=f"{ours}:MESH", spz=f"{ours}:SPZ")
    out = tmp_path / "map.xyz"
    assert main(["export", str(results), "--to", "points", "--voxel", "1", "--out", str(out)]) == 0
    assert "points as text" in capsys.readouterr().out
    assert len(np.loadtxt(out)) == len(read_ply(results / "map.ply"))
    assert main(["export", str(results), "--to", "spz", "--voxel", "0.1"]) == 2
    assert "expected with --to mesh or points, got" in capsys.readouterr().err
