"""The written files, read by other libraries or decoded by the format's own rules, hold the map's values."""

import dataclasses
import json
import struct
from pathlib import Path
from typing import Any

import cv2
import laspy
import numpy as np
import pyoctomap
import pytest
import yaml

from gausslite.codec.ply import SH_C0, read_ply, write_ply
from gausslite.codec.run_files import KeyframeView, read_keyframe_views
from gausslite.domain.camera import Camera
from gausslite.domain.errors import InvalidInputError, MapFileError
from gausslite.domain.gaussians import Gaussians, move_gaussians
from gausslite.domain.pose import transform_of
from gausslite.plugins import Group, load
from gausslite_export.format import ExportSettings, Format, MapContent
from gausslite_export.formats import read_map, upright
from gausslite_export.occupancy import OccupancySettings, occupied_voxels
from gausslite_render.harmonics import COUNTS
from gausslite_render.splat_map import read_splats

COUNT = 50


def random_map(seed: int = 0, count: int = COUNT) -> Gaussians:
    rng = np.random.default_rng(seed)
    quats = rng.normal(size=(count, 4)).astype(np.float32)
    return Gaussians(
        rng.uniform(-2, 2, (count, 3)).astype(np.float32),
        quats / np.linalg.norm(quats, axis=1, keepdims=True),
        rng.uniform(0.005, 0.05, (count, 3)).astype(np.float32),
        rng.uniform(0.4, 0.95, count).astype(np.float32),
        rng.uniform(0.05, 0.95, (count, 3)).astype(np.float32),
        rng.random(count) < 0.5,
        rng.integers(0, 1000, count).astype(np.uint32),
        rng.integers(-1, 3, count).astype(np.int16),
    )


def no_rendering(gaussians):
    raise AssertionError("only meshes and videos are rendered")


def export(tmp_path: Path, name: str, gaussians: Gaussians, region: str = "all", **options: Any) -> Path:
    source = tmp_path / "map.ply"
    write_ply(source, gaussians, "", options.pop("harmonics", None))
    chosen: Format = load(Group.EXPORTERS, name)
    out = tmp_path / f"out{chosen.suffix}"
    content = read_map(source, region, max_extent_m=chosen.max_extent_m)
    chosen.write(out, content, ExportSettings(no_rendering, **{"voxel_m": 0.05, **options}))
    return out


def test_ply_of_the_region_holds_exactly_its_gaussians(tmp_path):
    gaussians = random_map()
    written = read_ply(export(tmp_path, "ply", gaussians, region="roi"))
    assert len(written) == gaussians.active.sum()
    np.testing.assert_allclose(written.means_m, gaussians.means_m[gaussians.active])
    assert (written.kappa == gaussians.kappa[gaussians.active]).all()


PACKED = [("compressed-ply", None), ("ksplat", None), ("sog", None), ("splat", None), *(("spz", n) for n in (2, 3, 4))]
"""Formats that the library writes, with the version of SPZ."""
SPLATS = ("centers", "scales", "quaternions", "colors", "sh_coefficients")


@pytest.mark.parametrize("degree", [0, 1, 3])
@pytest.mark.parametrize(("name", "version"), PACKED)
def test_a_packed_file_is_read_within_its_resolution_in_the_map_s_own_axes(tmp_path, name, version, degree):
    rng, sent = np.random.default_rng(degree), random_map(count=300)
    harmonics = rng.uniform(-0.9, 0.9, (300, 3, COUNTS[degree])).astype(np.float32)
    read = read_splats(export(tmp_path, name, sent, harmonics=harmonics, spz_version=version))
    distances_m = np.linalg.norm(read.gaussians.means_m[None] - sent.means_m[:, None], axis=2)
    order, got = distances_m.argmin(axis=1), read.gaussians
    assert sorted(order) == list(range(300))
    np.testing.assert_allclose(got.means_m[order], sent.means_m, atol=2.5e-3)
    np.testing.assert_allclose(got.scales_m[order], sent.scales_m, rtol=0.04)
    np.testing.assert_allclose(got.opacities[order], sent.opacities, atol=0.003)
    np.testing.assert_allclose(got.rgb[order], sent.rgb, atol=0.005)
    assert np.abs((got.quats_wxyz[order] * sent.quats_wxyz).sum(axis=1)).min() > 0.993
    kept = harmonics if name not in ("splat", "ksplat") else harmonics[:, :, :0]
    np.testing.assert_allclose(read.harmonics[order], kept, atol=0.09)


def test_splat_rows_hold_32_bytes_most_visible_first(tmp_path):
    gaussians = random_map()
    raw = export(tmp_path, "splat", gaussians).read_bytes()
    assert len(raw) == 32 * COUNT
    size = gaussians.opacities * gaussians.scales_m.prod(axis=1)
    largest = int(size.argmax())
    np.testing.assert_allclose(struct.unpack("<6f", raw[:24])[:3], gaussians.means_m[largest], rtol=1e-6)
    np.testing.assert_allclose(np.array(list(raw[24:27])) / 255, gaussians.rgb[largest], atol=0.003)
    np.testing.assert_allclose(raw[27] / 255, gaussians.opacities[largest], atol=0.003)
    quat = (np.array(list(raw[28:32])) - 128) / 128
    assert abs(quat @ gaussians.quats_wxyz[largest]) > 0.999


def read_glb(path: Path) -> tuple[dict, dict[str, np.ndarray]]:
    raw = path.read_bytes()
    magic, version, total = struct.unpack_from("<III", raw)
    assert (magic, version, total) == (0x46546C67, 2, len(raw))
    length, kind = struct.unpack_from("<II", raw, 12)
    assert kind == 0x4E4F534A
    assert length % 4 == 0
    scene = json.loads(raw[20 : 20 + length])
    binary = raw[28 + length :]
    columns = {}
    for name, index in scene["meshes"][0]["primitives"][0]["attributes"].items():
        accessor = scene["accessors"][index]
        view = scene["bufferViews"][accessor["bufferView"]]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        values = np.frombuffer(binary, "<f4", accessor["count"] * width, view["byteOffset"])
        columns[name] = values.reshape(-1, width)
    return scene, columns


def test_gltf_has_the_extensions_attributes_and_units(tmp_path):
    gaussians = random_map()
    scene, columns = read_glb(export(tmp_path, "gltf", gaussians))
    primitive = scene["meshes"][0]["primitives"][0]
    assert scene["extensionsUsed"] == ["KHR_gaussian_splatting"]
    assert primitive["mode"] == 0
    assert primitive["extensions"]["KHR_gaussian_splatting"] == {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
        "projection": "perspective",
        "sortingMethod": "cameraDistance",
    }
    np.testing.assert_allclose(columns["POSITION"], gaussians.means_m)
    np.testing.assert_allclose(columns["KHR_gaussian_splatting:SCALE"], gaussians.scales_m, rtol=1e-5)
    np.testing.assert_allclose(columns["KHR_gaussian_splatting:OPACITY"][:, 0], gaussians.opacities, atol=1e-6)
    np.testing.assert_allclose(
        columns["KHR_gaussian_splatting:ROTATION"], gaussians.quats_wxyz[:, [1, 2, 3, 0]], atol=1e-6
    )
    harmonics = columns["KHR_gaussian_splatting:SH_DEGREE_0_COEF_0"]
    np.testing.assert_allclose(harmonics * SH_C0 + 0.5, gaussians.rgb, atol=1e-6)
    np.testing.assert_allclose(scene["accessors"][0]["min"], gaussians.means_m.min(axis=0))


def test_gltf_point_colours_are_linear_light_as_gltf_defines_them(tmp_path):
    grey = dataclasses.replace(random_map(), rgb=np.full((COUNT, 3), 0.5, np.float32))
    _, columns = read_glb(export(tmp_path, "gltf", grey))
    np.testing.assert_allclose(columns["COLOR_0"][:, :3], 0.21404, atol=1e-5)
    np.testing.assert_allclose(columns["COLOR_0"][:, 3], grey.opacities, atol=1e-6)


def test_pcd_rows_follow_the_header(tmp_path):
    gaussians = random_map()
    header, body = export(tmp_path, "pcd", gaussians).read_bytes().split(b"DATA binary\n", 1)
    fields = dict(line.split(" ", 1) for line in header.decode().splitlines() if not line.startswith("#"))
    types = {"F4": "<f4", "U4": "<u4", "I2": "<i2", "U1": "u1"}
    columns = zip(fields["FIELDS"].split(), fields["TYPE"].split(), fields["SIZE"].split(), strict=True)
    rows = np.frombuffer(body, np.dtype([(name, types[kind + size]) for name, kind, size in columns]))
    assert len(rows) == int(fields["POINTS"]) == COUNT
    np.testing.assert_allclose(np.stack([rows[axis] for axis in "xyz"], axis=1), gaussians.means_m)
    packed = rows["rgb"].view("<u4")
    red, blue = (packed >> 16) & 255, packed & 255
    np.testing.assert_allclose(red / 255, gaussians.rgb[:, 0], atol=0.003)
    np.testing.assert_allclose(blue / 255, gaussians.rgb[:, 2], atol=0.003)
    assert (rows["kappa"] == gaussians.kappa).all()


def test_las_is_read_by_laspy(tmp_path):
    gaussians = random_map()
    points = laspy.read(export(tmp_path, "las", gaussians))
    np.testing.assert_allclose(points.xyz, gaussians.means_m, atol=1e-4)
    np.testing.assert_allclose(np.asarray(points.red) / 65535, gaussians.rgb[:, 0], atol=1e-4)
    assert (np.asarray(points.kappa) == gaussians.kappa).all()


def plate(height_m: float, size_m: float = 1.0) -> Gaussians:
    """Return flat Gaussians that cover a horizontal square."""
    axis = np.arange(-size_m / 2, size_m / 2, 0.02) + 0.01
    x, y = (values.ravel() for values in np.meshgrid(axis, axis))
    n = len(x)
    return Gaussians(
        np.stack([x, y, np.full(n, height_m)], axis=1).astype(np.float32),
        np.tile(np.array([1, 0, 0, 0], np.float32), (n, 1)),
        np.tile(np.array([0.01, 0.01, 0.001], np.float32), (n, 1)),
        np.full(n, 0.9, np.float32),
        np.full((n, 3), 0.5, np.float32),
        np.ones(n, np.bool_),
        np.ones(n, np.uint32),
        np.zeros(n, np.int16),
    )


def test_occupied_voxels_cover_the_ellipsoid_of_a_long_gaussian():
    single = plate(0.525).take(np.array([0]))
    half = np.sqrt(0.5).astype(np.float32)
    # the long axis of the scales, x, turns by 90 degrees about z and lies along y
    long = Gaussians(
        np.array([[0.025, 0.025, 0.525]], np.float32),
        np.array([[half, 0, 0, half]], np.float32),
        np.array([[0.2, 0.001, 0.001]], np.float32),
        *(getattr(single, name) for name in ("opacities", "rgb", "active", "kappa", "target")),
    )
    voxels = occupied_voxels(long, OccupancySettings(voxel_m=0.05))
    assert (voxels[:, [0, 2]] == [0, 10]).all()
    assert voxels[:, 1].min() == np.floor((0.025 - 0.3) / 0.05)
    assert voxels[:, 1].max() == np.floor((0.025 + 0.3) / 0.05)
    assert len(np.unique(voxels[:, 1])) == voxels[:, 1].max() - voxels[:, 1].min() + 1


def test_faint_gaussians_occupy_nothing():
    assert len(occupied_voxels(plate(0), OccupancySettings(min_opacity=0.95))) == 0


@pytest.mark.parametrize("name", ["octomap", "nav2"])
def test_a_map_that_is_too_faint_to_occupy_a_voxel_is_refused(tmp_path, name):
    faint = dataclasses.replace(plate(0.5), opacities=np.full(len(plate(0.5)), 0.1, np.float32))
    with pytest.raises(InvalidInputError, match=r"--min-opacity 0\.3: expected an opacity .* at most 0\.10"):
        export(tmp_path, name, faint)


@pytest.mark.parametrize(
    ("name", "message"),
    [("octomap", "octomap: expected a map within 1638"), ("nav2", "nav2: expected at most 67108864 cells")],
)
def test_a_map_beyond_the_grid_is_refused_before_memory_is_taken(tmp_path, name, message):
    room = plate(0.5)
    means_m = room.means_m.copy()
    means_m[::2, :2] += 5000
    pytest.raises(InvalidInputError, export, tmp_path, name, dataclasses.replace(room, means_m=means_m)).match(message)


def test_too_many_samples_of_large_gaussians_are_refused(tmp_path):
    large = dataclasses.replace(plate(0.5, size_m=4), scales_m=np.full((40_000, 3), 2, np.float32))
    with pytest.raises(InvalidInputError, match=r"--voxel 0\.05: expected at most 268435456 samples"):
        export(tmp_path, "octomap", large)


def test_spz_leaves_out_what_its_integers_cannot_hold(tmp_path):
    gaussians = random_map()
    gaussians.means_m[7, 1] = -2100
    read = read_splats(export(tmp_path, "spz", gaussians)).gaussians
    np.testing.assert_allclose(read.means_m, np.delete(gaussians.means_m, 7, axis=0), atol=1e-3)


def test_a_recording_of_rerun_has_splats_keyframes_and_boxes_at_their_times(tmp_path):
    chunk = pytest.importorskip("rerun.chunk", reason="needs the extra `rerun`")
    gaussians, camera = random_map(), Camera.centred(60.0, 64, 48)
    views = [KeyframeView(i, i * 10**9, camera, np.eye(4), 0) for i in (0, 1)]
    places = {"centroid_m": [1, 2, 3], "min_m": [0, 1, 2], "max_m": [2, 3, 4]}
    mug = {"id": "mug-1", "noun": "mug", "role": "target", "confidence": 0.9, "first_seen_ns": 5, "last_seen_ns": 6}
    report = {"up": [0.0, -1.0, 0.0], "objects": [mug | places]}
    harmonics = np.random.default_rng(0).uniform(-1, 1, (COUNT, 3, 8)).astype(np.float32)
    content = MapContent(gaussians, gaussians, views=views, report=report, harmonics=harmonics)
    load(Group.EXPORTERS, "rrd").write(tmp_path / "map.rrd", content, ExportSettings(no_rendering))
    batches = {str(c.entity_path): c.to_record_batch() for c in chunk.RrdReader(tmp_path / "map.rrd").stream()}
    splats = {name: np.array(batches["/map/gaussians"][f"GaussianSplats3D:{name}"].to_pylist()[0]) for name in SPLATS}
    np.testing.assert_allclose(splats["centers"], gaussians.means_m)
    np.testing.assert_allclose(splats["scales"], gaussians.scales_m)
    np.testing.assert_allclose(splats["quaternions"], gaussians.quats_wxyz[:, [1, 2, 3, 0]])
    np.testing.assert_allclose(splats["colors"] >> 24, gaussians.rgb[:, 0] * 255, atol=0.51)
    np.testing.assert_allclose(splats["colors"] & 255, gaussians.opacities * 255, atol=0.51)
    coefficients = splats["sh_coefficients"].reshape(COUNT, 15, 3)
    padded = np.pad(harmonics, ((0, 0), (0, 0), (0, 7)))
    np.testing.assert_allclose(coefficients, padded.transpose(0, 2, 1), atol=1e-3)  # half floats
    assert batches["/map/keyframe"].num_rows == 2
    assert [time.value for time in batches["/map/objects/mug-1"]["capture_time"]] == [5]
    R_upright_map = np.reshape(batches["/map"]["Transform3D:mat3x3"].to_pylist()[0], (3, 3)).T
    np.testing.assert_allclose(R_upright_map @ [0, -1, 0], [0, 0, 1], atol=1e-6)


def test_octomap_marks_the_surface_and_nothing_else(tmp_path):
    tree = pyoctomap.OcTree(0.1)
    tree.readBinary(str(export(tmp_path, "octomap", plate(0.525), region="roi")))
    assert tree.getResolution() == pytest.approx(0.05)
    inside, above = tree.search([0.02, 0.02, 0.52]), tree.search([0.02, 0.02, 0.72])
    assert inside
    assert tree.isNodeOccupied(inside)
    assert not above
    assert tree.getMetricMax()[2] == pytest.approx(0.55)


def test_nav2_grid_has_obstacles_floor_and_unknown_cells(tmp_path):
    table = plate(0.7, size_m=0.5)
    room = Gaussians.concatenate([plate(0.0, size_m=2.0), table])
    described = yaml.safe_load(export(tmp_path, "nav2", room).read_text())
    image = cv2.imread(str(tmp_path / described["image"]), cv2.IMREAD_UNCHANGED)

    def cell(x_m: float, y_m: float) -> int:
        column = int((x_m - described["origin"][0]) / described["resolution"])
        row = image.shape[0] - 1 - int((y_m - described["origin"][1]) / described["resolution"])
        return int(image[row, column])

    assert cell(0.0, 0.0) == 0  # the table
    assert cell(0.2, -0.2) == 0
    assert cell(0.8, -0.8) == 254  # the floor
    assert set(np.unique(image)) <= {0, 205, 254}
    # as map servers load it, whether they compare with a threshold itself or beyond it
    share = {grey: (255 - grey) / 255 for grey in (0, 205, 254)}
    assert share[254] < described["free_thresh"] < share[205] < described["occupied_thresh"] < share[0]


@pytest.mark.parametrize("name", ["nav2", "octomap"])
@pytest.mark.parametrize("fault", ["far", "large"])
def test_an_outlier_does_not_decide_the_size_of_a_grid(tmp_path, capsys, name, fault):
    room = plate(0.0, size_m=2.0)
    size_bytes = export(tmp_path, name, room).stat().st_size
    (room.means_m if fault == "far" else room.scales_m)[0] = 9e3
    assert export(tmp_path, name, room).stat().st_size == pytest.approx(size_bytes, rel=0.2)
    assert "left out 1 Gaussians that lie or reach farther than" in capsys.readouterr().err


@pytest.mark.parametrize("up", [(0.0, -1.0, 0.0), (0.0, 0.6, -0.8), (0.0, 0.0, -1.0), (0.0, 0.0, 1.0)])
def test_a_map_with_another_up_is_turned_until_z_points_up(up):
    room = Gaussians.concatenate([plate(0.0, size_m=2.0), plate(0.7, size_m=0.5)])
    T_map_upright = transform_of(np.array([0.0, 0.0, 0.0, -np.arctan2(up[1], up[2]), 0.0, 0.0]))
    turned = move_gaussians(room, T_map_upright)
    content = upright(MapContent(turned, turned, report={"up": list(up)}))
    np.testing.assert_allclose(content.chosen.means_m, room.means_m, atol=1e-6)
    assert len(content.notes) == (up != (0.0, 0.0, 1.0))
    with pytest.raises(InvalidInputError, match="up: expected three numbers"):
        upright(MapContent(turned, turned, report={"up": "north"}))


def test_a_map_without_a_region_or_file_and_damaged_keyframes_are_refused(tmp_path):
    inactive = dataclasses.replace(random_map(), active=np.zeros(COUNT, np.bool_))
    pytest.raises(MapFileError, read_map, tmp_path, "all").match(r"map\.ply")
    pytest.raises(InvalidInputError, export, tmp_path, "octomap", inactive, region="roi").match("--region all")
    (tmp_path / "keyframes.json").write_text('{"keyframes": [{"index": 1}]}')
    pytest.raises(MapFileError, read_keyframe_views, tmp_path).match("keyframes")
