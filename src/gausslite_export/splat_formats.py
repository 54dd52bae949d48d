"""Encode all Gaussians for splat viewers: packed files and glTF with KHR_gaussian_splatting.

These formats have no columns for kappa, the active flag and the target; a map's own PLY file keeps them.
"""

from __future__ import annotations

import json
import struct
from bisect import bisect_right
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from gausslite.codec.ply import SH_C0, ply_bytes
from gausslite.codec.state_file import write_atomic
from gausslite.domain.errors import InvalidInputError
from gausslite.domain.gaussians import Gaussians
from gausslite.process import import_extra
from gausslite_export.format import MapContent
from gausslite_render.harmonics import COUNTS
from gausslite_render.viewer import by_place
from gausslite_selection.colours import linear_light

SPZ_VERSION, SPZ_VERSIONS = 3, (2, 3, 4)
_HALF = np.float32(0.5 / 255)
MAX_SPZ_COORDINATE_M = 2047.0
"""SPZ positions are 24-bit integers with 12 fractional bits."""
_GLB_MAGIC, _GLB_VERSION, _GLB_JSON, _GLB_BINARY = 0x46546C67, 2, 0x4E4F534A, 0x004E4942
_FLOAT, _POINTS, _ARRAY_BUFFER = 5126, 0, 34962
_Z_UP_TO_Y_UP_XYZW = (-np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5))
"""The rotation that a glTF node applies to a map whose z axis points up; glTF's y axis points up."""


def write_packed(path: Path, kind: str, content: MapContent, spz_version: int = SPZ_VERSION) -> None:
    """Write the chosen Gaussians with the gaussforge library; kind: its name of the format.

    Raises InvalidInputError without the library, StorageError.
    """
    library = import_extra("gaussforge", "export", "packed splat files")
    source = ply_bytes(*_as_read(kind, content.chosen, content.harmonics))
    written = library.GaussForge().convert(source, "ply", kind, spz_version=spz_version)
    if "data" not in written:
        raise InvalidInputError(f"{path}: expected a map that gaussforge can write, got: {written['error']}")
    write_atomic(path, written["data"])


def _as_read(
    kind: str, gaussians: Gaussians, harmonics: Float32[ndarray, "n 3 k"] | None
) -> tuple[Gaussians, str, Float32[ndarray, "n 3 k"] | None]:
    """Return the map such that readers of the written file get it as it is, in an order that suits them."""
    gaussians = replace(gaussians, quats_wxyz=_unit_quaternions(gaussians))
    if kind == "compressed.ply":
        # 256 Gaussians in the file's order share the limits between which their positions are rounded
        order = by_place(gaussians.means_m)
        if harmonics is not None:  # the library writes coefficient by coefficient, readers expect channel by channel
            harmonics = harmonics[order].reshape(len(order), -1, 3).transpose(0, 2, 1)
        return gaussians.take(order), "", harmonics
    if kind in ("sog", "spz"):
        return gaussians, "", harmonics
    # viewers show these files while they load: the most visible first; the library rounds down
    order = np.argsort(-gaussians.opacities * np.prod(gaussians.scales_m, axis=1), kind="stable")
    rounded = replace(gaussians, rgb=gaussians.rgb + _HALF, opacities=gaussians.opacities + _HALF)
    return rounded.take(order), "", None


def write_gltf(path: Path, gaussians: Gaussians, harmonics: Float32[ndarray, "n 3 k"] | None = None) -> None:
    """Write a binary glTF file (.glb): points with the extension KHR_gaussian_splatting, release candidate.

    Scales are metres and opacities linear. COLOR_0 lets viewers without the extension show coloured points; glTF
    defines its colours as linear light, so the map's sRGB colours are decoded. Raises StorageError.
    """
    colours = np.concatenate([linear_light(np.clip(gaussians.rgb, 0, 1)), gaussians.opacities[:, None]], axis=1)
    columns = {
        "POSITION": gaussians.means_m,
        "COLOR_0": colours,
        "KHR_gaussian_splatting:ROTATION": _unit_quaternions(gaussians)[:, [1, 2, 3, 0]],
        "KHR_gaussian_splatting:SCALE": gaussians.scales_m,
        "KHR_gaussian_splatting:OPACITY": gaussians.opacities,
        "KHR_gaussian_splatting:SH_DEGREE_0_COEF_0": _degree_0(gaussians),
    }
    for i, coefficients in enumerate([] if harmonics is None else harmonics.transpose(2, 0, 1)):
        degree = bisect_right(COUNTS, i)
        columns[f"KHR_gaussian_splatting:SH_DEGREE_{degree}_COEF_{i - COUNTS[degree - 1]}"] = coefficients
    write_atomic(path, _glb(columns, len(gaussians)))


def _glb(columns: dict[str, Float32[ndarray, "n *k"]], count: int) -> bytes:
    """Return a GLB container: header, JSON chunk, binary chunk with one buffer view per column."""
    views, accessors, chunks, offset = [], [], [], 0
    for name, values in columns.items():
        data = np.ascontiguousarray(values, "<f4").tobytes()
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": len(data), "target": _ARRAY_BUFFER})
        kind = "SCALAR" if values.ndim == 1 else f"VEC{values.shape[1]}"
        accessor = {"bufferView": len(views) - 1, "componentType": _FLOAT, "count": count, "type": kind}
        if name == "POSITION":  # glTF requires the bounds of positions
            accessor |= {"min": values.min(axis=0).tolist(), "max": values.max(axis=0).tolist()}
        accessors.append(accessor)
        chunks.append(data)
        offset += len(data)
    scene = _gltf_scene({name: i for i, name in enumerate(columns)}) | {
        "buffers": [{"byteLength": offset}],
        "bufferViews": views,
        "accessors": accessors,
    }
    text, binary = _padded(json.dumps(scene).encode(), b" "), b"".join(chunks)
    total = 12 + 8 + len(text) + 8 + len(binary)
    return (
        struct.pack("<III", _GLB_MAGIC, _GLB_VERSION, total)
        + struct.pack("<II", len(text), _GLB_JSON)
        + text
        + struct.pack("<II", len(binary), _GLB_BINARY)
        + binary
    )


def _gltf_scene(attributes: dict[str, int]) -> dict[str, object]:
    extension = {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
        "projection": "perspective",
        "sortingMethod": "cameraDistance",
    }
    primitive = {"mode": _POINTS, "attributes": attributes, "extensions": {"KHR_gaussian_splatting": extension}}
    return {
        "asset": {"version": "2.0", "generator": "GaussLite"},
        "extensionsUsed": ["KHR_gaussian_splatting"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "rotation": [float(value) for value in _Z_UP_TO_Y_UP_XYZW]}],
        "meshes": [{"primitives": [primitive]}],
    }


def _padded(data: bytes, fill: bytes) -> bytes:
    return data + fill * (-len(data) % 4)


def _degree_0(gaussians: Gaussians) -> Float32[ndarray, "n 3"]:
    """Return the colours as coefficients of the spherical harmonic of degree 0."""
    return ((gaussians.rgb - 0.5) / SH_C0).astype(np.float32)


def _unit_quaternions(gaussians: Gaussians) -> Float32[ndarray, "n 4"]:
    lengths = np.linalg.norm(gaussians.quats_wxyz, axis=1, keepdims=True)
    identity = np.array([1, 0, 0, 0], np.float32)
    return np.where(lengths > 0, gaussians.quats_wxyz / np.maximum(lengths, 1e-12), identity).astype(np.float32)
