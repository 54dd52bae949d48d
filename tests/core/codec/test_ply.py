"""PLY maps: round trips, exchange with another tool, world frame names, and errors of damaged files."""

import resource
from pathlib import Path

import gaussforge
import numpy as np
import numpy.lib.recfunctions as rfn
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sample_gaussians import random_gaussians

from gausslite.codec.ply import (
    gaussians_from_ply,
    ply_bytes,
    read_ply,
    read_stored_map,
    read_world_frame,
    world_frame_from_ply,
    write_ply,
)
from gausslite.domain.errors import InvalidInputError, MapFileError, StorageError
from gausslite.domain.gaussians import Gaussians


def assert_same(got: Gaussians, sent: Gaussians) -> None:
    for name in ("active", "kappa", "target", "means_m", "quats_wxyz"):
        np.testing.assert_array_equal(getattr(got, name), getattr(sent, name))
    for name in ("scales_m", "opacities", "rgb"):
        np.testing.assert_allclose(getattr(got, name), getattr(sent, name), rtol=2e-5, atol=1e-6)


@pytest.mark.parametrize("n", [0, 1, 50])
def test_a_written_map_is_read_back(tmp_path: Path, n: int) -> None:
    path = tmp_path / "map.ply"
    write_ply(path, random_gaussians(n))
    assert_same(read_ply(path), random_gaussians(n))
    assert [file.name for file in tmp_path.iterdir()] == ["map.ply"]


def test_opacities_of_zero_and_one_stay_finite() -> None:
    gaussians = random_gaussians(2)
    gaussians.opacities[:] = [0.0, 1.0]
    np.testing.assert_allclose(gaussians_from_ply(ply_bytes(gaussians)).opacities, [0, 1], atol=2e-6)


def test_a_kappa_beyond_float_precision_is_clipped() -> None:
    gaussians = random_gaussians(1)
    gaussians.kappa[:] = 2**32 - 1
    assert gaussians_from_ply(ply_bytes(gaussians)).kappa.tolist() == [2**32 - 1]


def test_files_are_exchanged_with_another_tool(tmp_path: Path) -> None:
    sent = random_gaussians(50, max_kappa=2**24)
    ours, convert = ply_bytes(sent), gaussforge.GaussForge().convert
    row = np.dtype([("mean_m", "<f4", 3), ("scale_m", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)])
    theirs = np.frombuffer(convert(ours, "ply", "splat")["data"], row)
    np.testing.assert_allclose(theirs["mean_m"], sent.means_m)
    np.testing.assert_allclose(theirs["scale_m"], sent.scales_m, rtol=1e-5)
    np.testing.assert_allclose(theirs["rgba"][:, 3] / 255, sent.opacities, atol=0.004)
    np.testing.assert_allclose(theirs["rgba"][:, :3] / 255, np.clip(sent.rgb, 0, 1), atol=0.004)
    (tmp_path / "theirs.ply").write_bytes(convert(ours, "ply", "ply")["data"])
    read = read_ply(tmp_path / "theirs.ply")
    np.testing.assert_allclose(read.rgb, sent.rgb, atol=1e-6)
    assert not read.active.any()
    assert not read.kappa.any()
    assert (read.target == -1).all()


def test_columns_that_no_map_has_are_named(tmp_path: Path) -> None:
    rows = rfn.append_fields(
        other_tools_rows(), [f"semantic_{i}" for i in range(4)], [np.ones(9, "f4")] * 4, usemask=False
    )
    (tmp_path / "map.ply").write_bytes(other_tools_file(rows))
    [note] = read_stored_map(tmp_path / "map.ply").notes
    assert note == "left out 4 columns that no map here has: semantic_0, semantic_1, semantic_2, …"


def test_columns_are_found_by_name() -> None:
    """Normals, f_rest, doubles, comments, another order and a second element: all of it exists in the wild."""
    sent = random_gaussians(4)
    names = ["nx", "rot_3", "rot_2", "rot_1", "rot_0", "opacity", "f_rest_0", "scale_2", "scale_1", "scale_0"]
    names += ["f_dc_0", "f_dc_1", "f_dc_2", "x", "y", "z"]
    values = np.zeros((4, len(names)))
    for i in range(3):
        values[:, names.index(f"scale_{i}")] = np.log(sent.scales_m[:, i])
        values[:, names.index("xyz"[i])] = sent.means_m[:, i]
    for i in range(4):
        values[:, names.index(f"rot_{i}")] = sent.quats_wxyz[:, i]
    header = "ply\r\nformat binary_little_endian 1.0\r\ncomment by hand\r\nelement vertex 4\r\n"
    header += "".join(f"property double {name}\r\n" for name in names)
    header += "element face 0\r\nproperty list uchar int vertex_indices\r\nend_header\r\n"
    read = gaussians_from_ply(header.encode() + values.astype("<f8").tobytes())
    np.testing.assert_array_equal(read.means_m, sent.means_m)
    np.testing.assert_allclose(read.scales_m, sent.scales_m, rtol=1e-6)
    np.testing.assert_allclose(read.opacities, 0.5)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda data: data[:-1], "expected 3 Gaussians"),
        (lambda data: b"", "expected a PLY file"),
        (lambda data: b"glTF" + data[4:], "expected a PLY file"),
        (lambda data: data.replace(b"binary_little_endian", b"ascii"), "expected rows of 17 numbers"),
        (
            lambda data: data.replace(b"binary_little_endian", b"binary"),
            "expected a format of .* got format binary 1.0",
        ),
        (lambda data: data.replace(b"vertex 3", b"vertex 99999999999"), "expected 0 to 100000000 Gaussians"),
        (lambda data: data.replace(b"vertex 3", b"vertex -3"), "Gaussians, got '-3'"),
        (lambda data: data.replace(b"float opacity", b"float opaqueness"), "missing opacity"),
        (lambda data: data.replace(b"float y", b"float x"), "once per column"),
        (lambda data: data.replace(b"float y", b"list uchar int y"), "missing y"),
        (lambda data: data.replace(b"float y", b"list uchar int n\nproperty float y"), "element vertex: .* got a list"),
        (lambda data: data.replace(b"float x\n", b"float packed_position\n"), "got a compressed PLY"),
        (lambda data: data.replace(b"element vertex", b"element point"), "expected an element 'vertex', got point"),
        (lambda data: data[:-204] + b"\x00\x00\xc0\x7f" * 51, "column x: expected finite values"),
        # signalling: its conversion would warn
        (lambda data: data[:-204] + b"\x01\x00\x80\x7f" * 51, "column x: expected finite values"),
    ],
)
def test_the_error_of_a_damaged_map_names_the_file(tmp_path: Path, spoil: object, message: str) -> None:
    path = tmp_path / "map.ply"
    path.write_bytes(spoil(ply_bytes(random_gaussians(3))))  # type: ignore[operator]
    with pytest.raises(MapFileError, match=message) as caught:
        read_ply(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_missing_map_is_a_map_file_error(tmp_path: Path) -> None:
    pytest.raises(MapFileError, read_ply, tmp_path / "none.ply").match("No such file")


@given(st.data())
def test_a_flipped_byte_raises_only_map_file_error(data: st.DataObject) -> None:
    file = bytearray(ply_bytes(random_gaussians(2)))
    for _ in range(data.draw(st.integers(1, 3))):
        file[data.draw(st.integers(0, len(file) - 1))] = data.draw(st.integers(0, 255))
    try:
        gaussians_from_ply(bytes(file))
    except MapFileError as error:
        message = str(error)
    else:
        message = ""
    assert "\n" not in message


def test_a_full_disk_raises_storage_error_and_keeps_the_old_map(tmp_path: Path) -> None:
    path = tmp_path / "map.ply"
    write_ply(path, random_gaussians(3))
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limits[1]))
    try:
        pytest.raises(StorageError, write_ply, path, random_gaussians(500)).match("cannot be written")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert_same(read_ply(path), random_gaussians(3))
    assert [file.name for file in tmp_path.iterdir()] == ["map.ply"]
    pytest.raises(StorageError, write_ply, tmp_path / "no" / "map.ply", random_gaussians(3)).match("cannot be written")


@pytest.mark.parametrize("name", ["map", "Küche 2", "日本", "50% %41 \\", "end_header", "world frame"])
def test_the_world_frame_is_read_back_and_changes_nothing_else(name: str, tmp_path: Path) -> None:
    gaussians = random_gaussians(5)
    write_ply(tmp_path / "map.ply", gaussians, name)
    assert read_world_frame(tmp_path / "map.ply") == name
    assert ply_bytes(read_ply(tmp_path / "map.ply")) == ply_bytes(gaussians_from_ply(ply_bytes(gaussians)))
    assert world_frame_from_ply(ply_bytes(gaussians)) == ""
    [header] = (line for line in ply_bytes(gaussians, name).splitlines(keepends=True) if b"world_frame" in line)
    assert header.isascii()
    assert ply_bytes(gaussians, name).replace(header, b"", 1) == ply_bytes(gaussians)


@pytest.mark.parametrize("name", ["line\nbreak", "carriage\rreturn", "tab\t", "nul\0", "\u2028", "x" * 256, "\ud800"])
def test_a_world_frame_with_control_characters_or_too_long_is_refused(name: str, tmp_path: Path) -> None:
    pytest.raises(InvalidInputError, write_ply, tmp_path / "map.ply", random_gaussians(1), name).match("world frame")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("comments", [b"a\ncomment world_frame b", b"\xff", b"a\tb"])
def test_an_ambiguous_or_invalid_world_frame_in_a_file_is_refused(comments: bytes, tmp_path: Path) -> None:
    data = ply_bytes(random_gaussians(1), "NAME").replace(b"NAME", comments)
    (tmp_path / "map.ply").write_bytes(data)
    pytest.raises(MapFileError, read_world_frame, tmp_path / "map.ply").match(r"map\.ply: expected (one|a) world frame")


def test_a_world_frame_in_utf_8_of_an_earlier_file_is_read() -> None:
    data = ply_bytes(random_gaussians(1), "NAME").replace(b"NAME", "Küche".encode())
    assert world_frame_from_ply(data) == "Küche"


COLUMNS = ("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2")
ROW = np.dtype([(name, "<f4") for name in (*COLUMNS, "rot_0", "rot_1", "rot_2", "rot_3")])


def other_tools_file(rows: np.ndarray, file_format: str = "binary_little_endian", before: str = "") -> bytes:
    """Return the rows of ROW as another tool writes them; before: header of an element with one row of one float."""
    header = f"ply\nformat {file_format} 1.0\ncomment other tool\n{before}element vertex {len(rows)}\n"
    header += "".join(f"property float {name}\n" for name in rows.dtype.names or ()) + "end_header\n"
    if file_format == "ascii":
        lines = ["0.5"] * bool(before) + [" ".join(str(float(value)) for value in row) for row in rows.tolist()]
        return (header + "\n".join(lines) + "\n").encode()
    order = ">" if file_format == "binary_big_endian" else "<"
    return header.encode() + bytes(4 * bool(before)) + rows.astype(rows.dtype.newbyteorder(order)).tobytes()


def other_tools_rows(n: int = 9) -> np.ndarray:
    sent, rows = random_gaussians(n), np.zeros(n, ROW)
    for i in range(3):
        rows["xyz"[i]], rows[f"scale_{i}"] = sent.means_m[:, i], np.log(sent.scales_m[:, i])
    for i in range(4):
        rows[f"rot_{i}"] = sent.quats_wxyz[:, i]
    return rows


@pytest.mark.parametrize("before", ["", "element intrinsic 1\nproperty float f\n"])
@pytest.mark.parametrize("file_format", ["binary_little_endian", "binary_big_endian", "ascii"])
def test_every_format_of_ply_is_read_also_after_another_element(file_format: str, before: str) -> None:
    read = gaussians_from_ply(other_tools_file(other_tools_rows(), file_format, before))
    np.testing.assert_array_equal(read.means_m, random_gaussians(9).means_m)
    np.testing.assert_allclose(read.scales_m, random_gaussians(9).scales_m, rtol=1e-5)


def test_rows_of_another_length_in_ascii_are_refused() -> None:
    data = other_tools_file(other_tools_rows(), "ascii")
    for spoiled in (data[:-40], data.rstrip() + b" 7\n", data[:-8] + b"x" + data[-7:]):
        pytest.raises(MapFileError, gaussians_from_ply, spoiled).match(r"expected (9 )?rows of")


@pytest.mark.parametrize("file_format", ["binary_little_endian", "ascii"])
def test_infinite_logits_are_opaque_or_transparent_and_scales_flat(file_format: str) -> None:
    rows = other_tools_rows()
    rows["opacity"][:2], rows["scale_2"][2] = [np.inf, -np.inf], -np.inf
    read = gaussians_from_ply(other_tools_file(rows, file_format))
    np.testing.assert_allclose(read.opacities[:2], [1, 0], atol=1e-6)
    assert 0 < read.scales_m[2, 2] < 1e-30
    assert np.isfinite(gaussians_from_ply(ply_bytes(read)).scales_m).all()


@pytest.mark.parametrize(
    ("column", "value"), [("x", np.nan), ("z", np.inf), ("opacity", np.nan), ("scale_0", 90.0), ("rot_1", np.inf)]
)
def test_a_row_that_is_no_gaussian_is_left_out_with_one_line(tmp_path: Path, column: str, value: float) -> None:
    rows = other_tools_rows()
    rows[column][3] = value
    (tmp_path / "map.ply").write_bytes(other_tools_file(rows))
    lines: list[str] = []
    read = read_ply(tmp_path / "map.ply", lines.append)
    np.testing.assert_array_equal(read.means_m, np.delete(random_gaussians(9).means_m, 3, axis=0))
    assert lines == [
        f"{tmp_path}/map.ply: left out 1 of 9 Gaussians: column {column}: expected finite values, got NaN or infinity"
    ]
    with pytest.warns(UserWarning, match="left out 1 of 9"):
        read_ply(tmp_path / "map.ply")
    pytest.raises(MapFileError, gaussians_from_ply, other_tools_file(rows)).match(f"column {column}")
