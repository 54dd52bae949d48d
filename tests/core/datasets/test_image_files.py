"""Images as devices write them: turned by EXIF, with bytes after their end, or cut; the stored pixels are used."""

import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from tiny_sequences import write_seven_scenes

from gausslite.datasets.files import DepthUnits, decode_image, read_depth
from gausslite.datasets.open import open_source
from gausslite.domain.errors import DatasetError

PIXELS = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 256, (40, 64, 3), dtype=np.uint8), (0, 0), 3)
TRAILERS = [b"", bytes(1), bytes(5000), b"\xff\xd9" * 3, b"\xff\xd8\xff\xe0 another", b"text\n"]


def encoded(suffix: str, *options: int) -> bytes:
    return cv2.imencode(suffix, PIXELS, list(options))[1].tobytes()


def tiff_with_orientation(orientation: int) -> bytes:
    entry = (0x112).to_bytes(2, "big") + (3).to_bytes(2, "big") + (1).to_bytes(4, "big")
    return b"MM\0*\0\0\0\x08\0\x01" + entry + orientation.to_bytes(2, "big") + bytes(6)


def jpeg_segment(kind: int, content: bytes) -> bytes:
    return bytes([0xFF, kind]) + (len(content) + 2).to_bytes(2, "big") + content


def with_orientation(data: bytes, orientation: int) -> bytes:
    tiff = tiff_with_orientation(orientation)
    if data.startswith(b"\x89PNG"):
        chunk = b"eXIf" + tiff
        return data[:33] + len(tiff).to_bytes(4, "big") + chunk + zlib.crc32(chunk).to_bytes(4, "big") + data[33:]
    return data[:2] + jpeg_segment(0xE1, b"Exif\0\0" + tiff) + data[2:]


def decoded(data: bytes) -> np.ndarray:
    return decode_image("image", data, cv2.IMREAD_COLOR)


FORMATS = {
    "png": encoded(".png"),
    "jpeg": encoded(".jpg"),
    "progressive": encoded(".jpg", cv2.IMWRITE_JPEG_PROGRESSIVE, 1),
    "restarts": encoded(".jpg", cv2.IMWRITE_JPEG_RST_INTERVAL, 2),
    "thumbnail": encoded(".jpg")[:2] + jpeg_segment(0xE1, b"Exif\0\0" + encoded(".jpg")) + encoded(".jpg")[2:],
}


@pytest.mark.parametrize("orientation", [2, 3, 6, 8])
@pytest.mark.parametrize("name", ["png", "jpeg"])
def test_orientation_of_exif_does_not_turn_the_pixels(name: str, orientation: int) -> None:
    turned = with_orientation(FORMATS[name], orientation)
    assert np.array_equal(decoded(turned), cv2.imdecode(np.frombuffer(FORMATS[name], np.uint8), cv2.IMREAD_COLOR))


@pytest.mark.parametrize("trailer", TRAILERS)
@pytest.mark.parametrize("name", FORMATS)
def test_bytes_after_the_end_are_ignored(name: str, trailer: bytes) -> None:
    assert np.array_equal(decoded(FORMATS[name] + trailer), decoded(FORMATS[name]))


@pytest.mark.parametrize("padding", [b"", bytes(96), bytes(5000)])
@pytest.mark.parametrize("share", [0.5, 0.9])
@pytest.mark.parametrize("name", FORMATS)
def test_a_cut_image_is_refused_with_padding_or_without(name: str, share: float, padding: bytes) -> None:
    data = FORMATS[name]
    with pytest.raises(DatasetError, match=r"image: expected (a whole|an undamaged) image"):
        decoded(data[: int(share * len(data))] + padding)


DEPTH = np.random.default_rng(1).integers(300, 60_000, (40, 64), dtype=np.uint16)


@pytest.mark.parametrize("comment", [b"", b"# SensReader\n"])
def test_depth_as_pgm_is_read_as_png_is(tmp_path: Path, comment: bytes) -> None:
    cv2.imwrite(str(tmp_path / "depth.png"), DEPTH)
    (tmp_path / "depth.pgm").write_bytes(b"P5\n" + comment + b"64 40\n65535\n" + DEPTH.astype(">u2").tobytes())
    as_png, as_pgm = (read_depth(tmp_path / f"depth.{kind}", DepthUnits(1000)) for kind in ("png", "pgm"))
    assert np.array_equal(as_png, as_pgm)


def test_frames_of_sensreader_have_depth_as_pgm(tmp_path: Path) -> None:
    folder = write_seven_scenes(tmp_path / "seq")
    expected = open_source(str(folder)).frame(0).depth_m
    for path in folder.glob("*.depth.png"):
        raw = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        path.with_suffix(".pgm").write_bytes(b"P5\n%d %d\n65535\n" % raw.shape[::-1] + raw.astype(">u2").tobytes())
        path.unlink()
    assert np.array_equal(open_source(str(folder)).frame(0).depth_m, expected)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"P5\n64 40\n65535\n" + bytes(5119), "depth.pgm: expected a whole image file, got one cut short"),
        (b"P5\n64 40\n255\n" + bytes(5120), "depth.pgm: expected a binary 16-bit PGM image, got"),
        (b"P2\n64 40\n65535\n1 2 3", "depth.pgm: expected a binary 16-bit PGM image, got"),
        (b"P5\n999999 999999\n65535\n", "depth.pgm: expected an image of 1 to"),
    ],
)
def test_another_pgm_is_refused(tmp_path: Path, data: bytes, message: str) -> None:
    (tmp_path / "depth.pgm").write_bytes(data)
    with pytest.raises(DatasetError, match=message):
        read_depth(tmp_path / "depth.pgm", DepthUnits(1000))
