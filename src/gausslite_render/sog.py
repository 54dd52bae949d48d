"""Decode SOG files: a ZIP archive of lossless WebP images, whose pixels are Gaussians, and their codebooks."""

from __future__ import annotations

import io
import json
import zipfile
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float32, UInt8
from numpy import ndarray
from numpy.typing import NDArray

from gausslite_render.harmonics import COUNTS
from gausslite_render.packed_splats import MAX_GAUSSIANS, Splats, require, require_count, rgb_of, with_largest

_CODES, _FIRST_LARGEST, _PALETTE_COLUMNS = 256, 252, 64
_SLACK_BYTES = 1 << 20


def decode_sog(data: bytes) -> Splats:
    """Decode version 2. Raises MapFileError, or what NumPy, OpenCV and zipfile raise for a damaged file."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        unpacked, limit = sum(entry.file_size for entry in archive.infolist()), 2 * len(data) + _SLACK_BYTES
        require(unpacked <= limit, f"images of at most {limit} bytes in the archive", unpacked)
        meta = json.loads(archive.read("meta.json"))
        count, version = meta["count"], meta.get("version")
        require(version == 2 and isinstance(count, int), "SOG of version 2", version)
        require_count(count)

        def pixels(part: str, index: int = 0) -> UInt8[ndarray, "n 4"]:
            return _image(archive.read(meta[part]["files"][index])).reshape(-1, 4)[:count]

        low, high = (np.array(meta["means"][name], np.float64) for name in ("mins", "maxs"))
        shares = (pixels("means")[:, :3] + 256.0 * pixels("means", 1)[:, :3]) / 65535
        logs = low + shares * (high - low)
        turns, sh0 = pixels("quats"), pixels("sh0")
        harmonics = np.zeros((count, 3, 0), np.float32)
        if "shN" in meta:
            labels = pixels("shN", 1).astype(np.int64)
            harmonics = _harmonics(meta["shN"], _image(archive.read(meta["shN"]["files"][0])), labels)
        columns = (logs, turns, sh0, harmonics)
        require(all(len(column) == count for column in columns), f"images of {count} pixels", "smaller ones")
        largest = np.clip(turns[:, 3].astype(np.int64) - _FIRST_LARGEST, 0, 3)
        return Splats(
            means_m=np.sign(logs) * np.expm1(np.abs(logs)),
            quats_wxyz=with_largest(largest, (turns[:, :3] / 255 - 0.5) * np.sqrt(2)),
            scales_m=np.exp(_codebook(meta["scales"])[pixels("scales")[:, :3]]),
            opacities=sh0[:, 3] / np.float32(255),
            rgb=rgb_of(_codebook(meta["sh0"])[sh0[:, :3]]),
            harmonics=harmonics,
        )


def _harmonics(
    meta: dict[str, Any], palette: UInt8[ndarray, "h w 4"], labels: NDArray[Any]
) -> Float32[ndarray, "n 3 k"]:
    """Return each Gaussian's entry of the palette; a row of its image has 64 entries."""
    require(meta["bands"] in (1, 2, 3), "harmonics of degree 1 to 3", meta["bands"])
    coefficients = COUNTS[meta["bands"]]
    entries = palette[:, : _PALETTE_COLUMNS * coefficients, :3].reshape(-1, coefficients, 3)
    coloured: Float32[ndarray, "n k 3"] = _codebook(meta)[entries[labels[:, 0] + 256 * labels[:, 1]]]
    return coloured.transpose(0, 2, 1)


def _codebook(meta: dict[str, Any]) -> Float32[ndarray, " 256"]:
    values = np.array(meta["codebook"], np.float32)
    require(values.shape == (_CODES,), f"a codebook of {_CODES} numbers", f"an array of shape {values.shape}")
    return values


def _image(data: bytes) -> UInt8[ndarray, "h w 4"]:
    """Return an image as red, green, blue, alpha; its size is checked first."""
    kind, bits = data[8:16], int.from_bytes(data[21:25], "little")
    require(kind == b"WEBPVP8L" and len(data) > 32, "lossless WebP images", kind)
    width, height = (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    require(width * height <= MAX_GAUSSIANS + (1 << 16), f"images of at most {MAX_GAUSSIANS} pixels", width * height)
    image: Any = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    require(image is not None and image.shape[:2] == (height, width), "WebP images", "damaged ones")
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGRA2RGBA if image.shape[2] == 4 else cv2.COLOR_BGR2RGBA))
