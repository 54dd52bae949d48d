"""Packed splat files: what their layouts mean, rows that are no Gaussians, and files that are damaged on purpose."""

import gzip
import io
import json
import struct
import zipfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
import pytest
from sample_gaussians import random_gaussians

from gausslite.codec.ply import SH_C0, ply_bytes
from gausslite.domain.errors import MapFileError
from gausslite_render.splat_map import read_splats

SPZ_MAGIC, HEADER, SECTION = 0x5053474E, 4096, 1024


def spz(count: int, payload: bytes, degree: int = 0) -> bytes:
    return gzip.compress(struct.pack("<IIIBBBB", SPZ_MAGIC, 2, count, degree, 12, 0, 0) + payload, mtime=0)


def spz_4(table: list[int], streams: int = 5, count: int = 1) -> bytes:
    header = struct.pack("<IIIBBBBI", SPZ_MAGIC, 4, count, 0, 12, 0, streams, 32).ljust(32, b"\0")
    return header + struct.pack(f"<{len(table)}Q", *table)


def compressed_ply(chunks: int, count: int, body: bytes, limits: int = 18, harmonics: str = "") -> bytes:
    columns = "".join(f"property float c{i}\n" for i in range(limits))
    words = "".join(f"property uint packed_{name}\n" for name in ("position", "rotation", "scale", "color"))
    start = f"ply\nformat binary_little_endian 1.0\ncomment x\nelement chunk {chunks}\n{columns}"
    return f"{start}element vertex {count}\n{words}{harmonics}end_header\n".encode() + body


def ksplat(rows: bytes, total: int, mode: int = 0, **stated: float) -> bytes:
    header, section = bytearray(HEADER), bytearray(SECTION)
    header[:2] = 0, 1
    sections = stated.pop("sections", 1)
    for at, value in ((4, sections), (16, total), (20, mode)):
        struct.pack_into("<H" if at == 20 else "<I", header, at, value)
    values = {"count": total, "room": total, "range": 32767} | stated
    places = {"count": 0, "room": 4, "capacity": 8, "buckets": 12, "range": 24, "full": 32, "partial": 36}
    for name, at in places.items():
        struct.pack_into("<I", section, at, values.get(name, 0))
    for name, at, kind in (("block_m", 16, "<f"), ("bucket_bytes", 20, "<H"), ("degree", 40, "<H")):
        struct.pack_into(kind, section, at, values.get(name, 0))
    return bytes(header) + bytes(section) + rows


def webp(rgba: np.ndarray) -> bytes:
    return cv2.imencode(".webp", rgba[..., [2, 1, 0, 3]], [cv2.IMWRITE_WEBP_QUALITY, 101])[1].tobytes()


def sog(replaced: dict[str, bytes] | None = None, **changes: object) -> bytes:
    """Return a SOG file of 4 equal Gaussians."""
    pixels = np.full((2, 2, 4), 255, np.uint8)
    book, names = [0.5] * 256, ("l.webp", "u.webp", "s.webp", "q.webp", "c.webp")
    meta = {
        "version": 2,
        "count": 4,
        "means": {"mins": [0, 0, 0], "maxs": [1, 2, -1], "files": names[:2]},
        "scales": {"codebook": book, "files": names[2:3]},
        "quats": {"files": names[3:4]},
        "sh0": {"codebook": book, "files": names[4:]},
    } | changes
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("meta.json", json.dumps(meta))
        for name, data in (dict.fromkeys(names, webp(pixels)) | (replaced or {})).items():
            archive.writestr(name, data)
    return out.getvalue()


def read(tmp_path: Path, name: str, data: bytes):
    (tmp_path / name).write_bytes(data)
    return read_splats(tmp_path / name)


def test_the_pixels_of_sog_are_between_limits_and_in_codebooks(tmp_path: Path) -> None:
    found = read(tmp_path, "a.sog", sog()).gaussians
    limit = np.expm1([1, 2, 1]) * [1, 1, -1]
    np.testing.assert_allclose(found.means_m, np.tile(limit, (4, 1)), rtol=1e-6)
    np.testing.assert_allclose(found.scales_m, np.exp(0.5), rtol=1e-6)
    np.testing.assert_allclose(found.rgb, 0.5 * SH_C0 + 0.5, rtol=1e-6)
    np.testing.assert_allclose(found.opacities, 1)


@pytest.mark.parametrize("mode", [1, 2])
def test_the_buckets_of_ksplat_place_its_gaussians(tmp_path: Path, mode: int) -> None:
    """Two full buckets of 2 and partial ones of 1 and 2; harmonics of degree 2 lie degree by degree."""
    sizes, centres_m = struct.pack("<2I", 1, 2), np.arange(12, dtype="<f4").reshape(4, 3) * 10
    row = np.dtype([("mean", "<u2", 3), ("size", "<f2", 3), ("quat", "<f2", 4), ("rgba", "u1", 4)])
    row = np.dtype([*row.descr, ("sh", "<f2" if mode == 1 else "u1", 24)])
    rows = np.zeros(7, row)
    rows["mean"], rows["size"], rows["quat"], rows["rgba"] = [40000, 32767, 30000], 0.5, [1, 0, 0, 0], [255, 0, 51, 204]
    rows["sh"] = np.arange(24)
    stated = {"capacity": 2, "buckets": 4, "full": 2, "partial": 2, "block_m": 5.0, "bucket_bytes": 12, "degree": 2}
    data = ksplat(sizes + centres_m.tobytes() + rows.tobytes(), 7, mode, **stated)
    found = read(tmp_path, "a.ksplat", data)
    offset_m = (np.array([40000, 32767, 30000]) - 32767) * 2.5 / 32767
    np.testing.assert_allclose(found.gaussians.means_m, centres_m[[0, 0, 1, 1, 2, 3, 3]] + offset_m, rtol=1e-6)
    np.testing.assert_allclose(found.gaussians.rgb, np.tile([1, 0, 0.2], (7, 1)), atol=1e-6)
    bands = np.arange(24) if mode == 1 else np.arange(24) / 255 * 3 - 1.5
    expected = np.concatenate([bands[:9].reshape(3, 3), bands[9:].reshape(3, 5)], axis=1)
    np.testing.assert_allclose(found.harmonics, np.tile(expected, (7, 1, 1)), atol=1e-6)


def test_a_compressed_ply_without_limits_of_colours_has_them_as_they_are(tmp_path: Path) -> None:
    limits = np.array([0, 0, 0, 4, 4, 4, -2, -2, -2, -2, -2, -2], "<f4")
    words = np.array([(2047 << 21) | 1023 << 11, 0, 0, 0xFF000033], "<u4")
    found = read(tmp_path, "a.ply", compressed_ply(1, 1, limits.tobytes() + words.tobytes(), limits=12)).gaussians
    np.testing.assert_allclose(found.means_m, [[4, 4, 0]])
    np.testing.assert_allclose(found.scales_m, np.exp(-2), rtol=1e-6)
    np.testing.assert_allclose([*found.rgb[0], found.opacities[0]], [1, 0, 0, 0.2], atol=1e-6)


def test_rows_of_nan_are_left_out(tmp_path: Path) -> None:
    rows = np.ones(3, np.dtype([("values", "<f4", 10), ("rgba", "u1", 4)]))
    rows["values"][1, 4] = np.nan
    found = read(tmp_path, "a.ksplat", ksplat(rows.tobytes(), 3))
    assert (len(found.gaussians), found.left_out, found.reason) == (2, 1, "expected finite values, got NaN or infinity")


MANY, HUGE = 20_000_001, 2**32 - 1
ONE_ROW = np.ones(11, "<f4").tobytes()
CHUNK = bytes(18 * 4)


@pytest.mark.parametrize(
    ("name", "data", "message"),
    [
        ("empty.spz", b"", "expected a .spz file, got an empty file"),
        ("zip.spz", b"PK\3\4" + bytes(40), "expected a .spz file, got a zip archive"),
        ("ply.spz", b"ply\nformat ascii 1.0\n", "expected a .spz file, got a PLY map"),
        ("spz.ply", spz(2, bytes(40)), "expected a PLY file, got an SPZ map"),
        ("count.spz", spz(HUGE, b""), "expected 1 to 20000000 Gaussians, got 4294967295"),
        ("sum.spz", spz(2, bytes(38))[:-8] + bytes(8), "a damaged one: CRC"),
        ("short.spz", spz(2, b"short"), "expected 38 bytes of 2 Gaussians, got 33 fewer"),
        ("cut.spz", spz(2, bytes(range(80)))[:60], "a damaged one|fewer"),
        ("degree.spz", spz(2, bytes(400), degree=4), "expected harmonics of degree 0 to 3, got 4"),
        ("table.spz", spz_4([5]), "a damaged one: buffer is smaller"),
        ("streams.spz", spz_4([5, 9] * 200, streams=200), "expected 5 streams, got 200"),
        ("wrap.spz", spz_4([2**64 - 1, 9] * 5), "a damaged one"),
        ("rows.splat", bytes(33), "expected rows of 32 bytes, got 33 bytes"),
        ("empty.splat", b"", "an empty file"),
        ("nan.splat", b"\0\0\xc0\x7f" * 8, "expected finite values, got NaN"),
        ("text.ply", b"glTF", "expected a PLY file"),
        ("count.ply", b"ply\nformat ascii 1.0\nelement vertex 99999999999\nend_header\n", "expected 0 to"),
        ("header.ply", compressed_ply(1, 1, CHUNK, limits=17), "header of SuperSplat's compressed PLY"),
        ("count.compressed.ply", compressed_ply(1, MANY, CHUNK), "expected 1 to 20000000 Gaussians, got 20000001"),
        ("chunks.ply", compressed_ply(1, 257, CHUNK), "a chunk for 256 of 257 Gaussians, got 1 chunks"),
        ("short.ply", compressed_ply(1, 2, CHUNK), "a damaged one: buffer is smaller"),
        ("sh.ply", compressed_ply(1, 1, CHUNK, harmonics="element sh 9\nproperty uchar f_rest_0\n"), "9 rows of 1"),
        ("empty.ksplat", b"", "an empty file"),
        ("sections.ksplat", ksplat(ONE_ROW, 1, sections=HUGE), "a damaged one: buffer is smaller"),
        ("count.ksplat", ksplat(ONE_ROW, MANY), "expected 1 to 20000000 Gaussians"),
        ("sum.ksplat", ksplat(ONE_ROW, 1, count=2, room=2), "sections of 1 Gaussians, got sections of 2"),
        ("room.ksplat", ksplat(ONE_ROW, 1, room=0), "at most 0 Gaussians in a section, got 1"),
        ("degree.ksplat", ksplat(ONE_ROW, 1, degree=60000), "harmonics of degree 0 to 3, got 60000"),
        ("partial.ksplat", ksplat(ONE_ROW, 1, partial=HUGE), "a damaged one: buffer is smaller"),
        ("bucket.ksplat", ksplat(ONE_ROW, 1, mode=1), "a damaged one: index"),
        ("zip.sog", b"PK\3\4" + bytes(40), "a damaged one: File is not a zip file"),
        ("bomb.sog", sog({"q.webp": bytes(10**8)}), "images of at most"),
        ("count.sog", sog(count=5), "images of 5 pixels, got smaller ones"),
        ("many.sog", sog(count=MANY), "expected 1 to 20000000 Gaussians"),
        ("version.sog", sog(version=1), "expected SOG of version 2, got 1"),
        ("means.sog", sog(means={"mins": [], "maxs": [1], "files": ["l.webp", "u.webp"]}), "a damaged one"),
        ("book.sog", sog(scales={"codebook": [1.0], "files": ["s.webp"]}), "a codebook of 256 numbers"),
        ("files.sog", sog(quats={"files": ["../q"]}), "a damaged one"),
        ("png.sog", sog({"q.webp": b"\x89PNG" + bytes(60)}), "expected lossless WebP images"),
        ("pixels.sog", sog({"q.webp": b"RIFF0000WEBPVP8L0000/\xff\xff\xff\x0f" + bytes(60)}), "images of at most"),
        ("palette.sog", sog(shN={"bands": 3, "codebook": [1.0] * 256, "files": ["s.webp", "q.webp"]}), "a damaged one"),
        ("missing.sog", None, "cannot read the map: No such file"),
    ],
)
def test_hostile_files_are_refused_in_one_line(tmp_path: Path, name: str, data: bytes | None, message: str) -> None:
    path = tmp_path / name
    if data is not None:
        path.write_bytes(data)
    with pytest.raises(MapFileError, match=message) as caught:
        read_splats(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def _cut(data: bytearray, rng: np.random.Generator) -> bytes:
    return bytes(data[: rng.integers(len(data))])


def _wrong_bytes(data: bytearray, rng: np.random.Generator) -> bytes:
    for _ in range(rng.integers(1, 20)):
        data[rng.integers(len(data))] = rng.integers(256)
    return bytes(data)


def _wrong_numbers(data: bytearray, rng: np.random.Generator) -> bytes:
    at = rng.integers(min(len(data) - 4, HEADER + 64))
    data[at : at + 4] = rng.choice([b"\xff\xff\xff\xff", b"\xff\xff\xff\x7f", b"\0\0\xc0\x7f", bytes(4)])
    return bytes(data)


@pytest.mark.parametrize("spoil", [_cut, _wrong_bytes, _wrong_numbers])
@pytest.mark.parametrize("suffix", [".compressed.ply", ".splat", ".ksplat", ".spz", ".sog"])
def test_a_spoilt_file_is_read_or_refused(
    tmp_path: Path, suffix: str, spoil: Callable[[bytearray, np.random.Generator], bytes]
) -> None:
    library = pytest.importorskip("gaussforge", reason="needs the extra `export`")
    rng, path = np.random.default_rng(0), tmp_path / f"a{suffix}"
    harmonics = rng.normal(0, 0.3, (40, 3, 15)).astype(np.float32)
    source = ply_bytes(random_gaussians(40), "", harmonics)
    written = [library.GaussForge().convert(source, "ply", suffix[1:], spz_version=n)["data"] for n in (2, 4)]
    for number in range(60):
        path.write_bytes(spoil(bytearray(written[number % 2]), rng))
        with suppress(MapFileError):
            found = read_splats(path)
            assert np.isfinite(found.gaussians.means_m).all()
            assert np.isfinite(found.harmonics).all()
