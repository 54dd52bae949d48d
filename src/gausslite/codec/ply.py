"""Read and write maps as standard 3DGS PLY files, binary little-endian, with three additional columns.

Columns: x y z | f_dc_0..2 = (rgb - 0.5) / C0 | opacity as logit | scale_0..2 as log | rot_0..3 = w x y z | additional:
active, kappa, target. All columns are float, because common readers read a row as a run of floats; so kappa is exact
up to 2^24. The reader finds columns by name, in any order and type. It ignores other tools' columns (normals, f_rest);
the additional ones may be missing (then inactive, kappa 0, no target). The header may name the map's world frame:
`comment world_frame NAME`.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from jaxtyping import Float32
from numpy import ndarray
from numpy.typing import DTypeLike, NDArray

from gausslite.codec.state_file import write_atomic
from gausslite.domain.checks import require_name
from gausslite.domain.errors import InvalidInputError, MapFileError
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.relevance import NO_TARGET

SH_C0 = 0.28209479177387814
_MAX_GAUSSIANS = 100_000_000
_MAX_HEADER_BYTES = 1 << 16
_WORLD_FRAME_COMMENT = "comment world_frame "
# the closest to 0 and 1 that a float32 sigmoid still distinguishes from them
_OPACITY_EDGE = 1e-6
_POSITIONS, _COLOURS = ("x", "y", "z"), ("f_dc_0", "f_dc_1", "f_dc_2")
_SCALES, _ROTATIONS = ("scale_0", "scale_1", "scale_2"), ("rot_0", "rot_1", "rot_2", "rot_3")
_STANDARD = (*_POSITIONS, *_COLOURS, "opacity", *_SCALES, *_ROTATIONS)
_EXTRAS = ("active", "kappa", "target")
_ROW = np.dtype([(name, "<f4") for name in (*_STANDARD, *_EXTRAS)])
_PLY_TYPES = {
    **{"char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "<i2", "int16": "<i2"},
    **{"ushort": "<u2", "uint16": "<u2", "int": "<i4", "int32": "<i4", "uint": "<u4", "uint32": "<u4"},
    **{"float": "<f4", "float32": "<f4", "double": "<f8", "float64": "<f8"},
}


def write_ply(path: Path, gaussians: Gaussians, world_frame: str = "") -> None:
    """Write the map atomically; the header names the world frame unless it is empty.

    Raises InvalidInputError for a name with line breaks or control characters, StorageError if writing fails.
    """
    write_atomic(path, ply_bytes(gaussians, world_frame))


def read_ply(path: Path) -> Gaussians:
    """Read a map. Raises MapFileError naming the file and the cause."""
    with _open_map(path) as file:
        return gaussians_from_ply(file.read())


def read_world_frame(path: Path) -> str:
    """Read the name of the world frame from a map's header; empty if it has none. Raises MapFileError."""
    with _open_map(path) as file:
        return world_frame_from_ply(file.read(_MAX_HEADER_BYTES))


def ply_bytes(gaussians: Gaussians, world_frame: str = "") -> bytes:
    """Encode the map as the bytes of a PLY file. Raises InvalidInputError as `write_ply`."""
    require_name("world frame", world_frame)
    rows = np.zeros(len(gaussians), _ROW)
    opacity = np.clip(gaussians.opacities.astype(np.float64), _OPACITY_EDGE, 1 - _OPACITY_EDGE)
    _fill(rows, _POSITIONS, gaussians.means_m)
    _fill(rows, _COLOURS, ((gaussians.rgb - 0.5) / SH_C0).astype(np.float32))
    _fill(rows, _SCALES, np.log(np.maximum(gaussians.scales_m, np.finfo(np.float32).tiny)))
    _fill(rows, _ROTATIONS, gaussians.quats_wxyz)
    rows["opacity"] = np.log(opacity / (1 - opacity))
    for name in _EXTRAS:
        rows[name] = getattr(gaussians, name)
    header = ["ply", "format binary_little_endian 1.0"]
    if world_frame:
        header.append(_WORLD_FRAME_COMMENT + world_frame)
    header.append(f"element vertex {len(gaussians)}")
    header += [f"property float {name}" for name in (*_STANDARD, *_EXTRAS)]
    return ("\n".join([*header, "end_header"]) + "\n").encode() + rows.tobytes()


def world_frame_from_ply(data: bytes) -> str:
    """Return the world frame named in the header of a PLY file; empty if it has none. Raises MapFileError."""
    end, _ = _header_extent(data)
    comments = {line for line in data[:end].splitlines() if line.startswith(_WORLD_FRAME_COMMENT.encode())}
    if not comments:
        return ""
    if len(comments) > 1:
        raise MapFileError(f"expected one world frame in the header, got {len(comments)}")
    try:
        name = comments.pop().decode().removeprefix(_WORLD_FRAME_COMMENT)
        require_name("world frame", name)
    except (InvalidInputError, UnicodeDecodeError) as error:
        raise MapFileError(f"expected a world frame's name in the header: {error}") from error
    return name


def gaussians_from_ply(data: bytes) -> Gaussians:
    """Decode the map in the bytes of a PLY file. Raises MapFileError."""
    count, row, start = _read_header(data)
    missing = [name for name in _STANDARD if name not in (row.names or ())]
    if missing:
        raise MapFileError(f"expected the columns of a 3DGS map, missing {', '.join(missing)}")
    if len(data) - start < count * row.itemsize:
        raise MapFileError(f"expected {count} Gaussians of {row.itemsize} bytes, got {len(data) - start} bytes of them")
    rows = np.frombuffer(data, row, count, start)
    present = [name for name in (*_STANDARD, *_EXTRAS) if name in (row.names or ())]
    not_finite = [name for name in present if not np.isfinite(rows[name]).all()]
    if not_finite:
        raise MapFileError(f"column {not_finite[0]}: expected finite values, got NaN or infinity")
    try:
        with np.errstate(over="raise"):
            return _to_gaussians({name: rows[name] for name in present}, count)
    except (InvalidInputError, FloatingPointError) as error:
        raise MapFileError(str(error)) from error


def _to_gaussians(raw: dict[str, NDArray[Any]], count: int) -> Gaussians:
    logits = np.clip(raw["opacity"].astype(np.float64), -60, 60)
    return Gaussians(
        means_m=_stack(raw, _POSITIONS),
        quats_wxyz=_stack(raw, _ROTATIONS),
        scales_m=np.exp(_stack(raw, _SCALES)),
        opacities=(1 / (1 + np.exp(-logits))).astype(np.float32),
        rgb=_stack(raw, _COLOURS) * np.float32(SH_C0) + np.float32(0.5),
        active=raw.get("active", np.zeros(count)) != 0,
        kappa=_to_integers(raw.get("kappa", np.zeros(count)), np.uint32),
        target=_to_integers(raw.get("target", np.full(count, NO_TARGET)), np.int16),
    )


def _read_header(data: bytes) -> tuple[int, np.dtype[np.void], int]:
    """Return the number of rows, the type of a row, and the first row's offset."""
    end, start = _header_extent(data)
    lines = [line.split() for line in data[:end].decode("ascii", "replace").splitlines()[1:]]
    lines = [line for line in lines if line and line[0] not in ("comment", "obj_info")]
    file_format = " ".join(lines[0]) if lines else "nothing"
    if file_format != "format binary_little_endian 1.0":
        raise MapFileError(f"expected format binary_little_endian 1.0, got {file_format}")
    if len(lines) < 2 or lines[1][:2] != ["element", "vertex"] or len(lines[1]) != 3:
        raise MapFileError("expected 'element vertex COUNT' as the first element")
    count = _count(lines[1][2])
    fields: dict[str, str] = {}
    for line in lines[2:]:
        # rows of other elements follow the vertices and are not read
        if line[0] == "element":
            break
        if len(line) != 3 or line[0] != "property" or line[1] not in _PLY_TYPES or line[2] in fields:
            raise MapFileError(f"expected 'property TYPE NAME' once per column, got {' '.join(line)!r}")
        fields[line[2]] = _PLY_TYPES[line[1]]
    return count, np.dtype(list(fields.items())), start


def _header_extent(data: bytes) -> tuple[int, int]:
    """Return the offsets of the header's last line and of the first row."""
    end = data.find(b"\nend_header", 0, _MAX_HEADER_BYTES) + 1
    if not data.startswith(b"ply") or end == 0:
        raise MapFileError("expected a PLY file, got something else")
    start = data.find(b"\n", end, end + 12) + 1
    if start == 0:
        raise MapFileError("the header has no end")
    return end, start


@contextmanager
def _open_map(path: Path) -> Iterator[BinaryIO]:
    """Open the file; errors of its content name it."""
    try:
        with Path(path).open("rb") as file:
            yield file
    except OSError as error:
        raise MapFileError(f"{path}: cannot read the map: {error.strerror or error}") from error
    except MapFileError as error:
        raise MapFileError(f"{path}: {error}") from error


def _count(text: str) -> int:
    if not text.isascii() or not text.isdigit() or len(text) > 12 or int(text) > _MAX_GAUSSIANS:
        raise MapFileError(f"expected 0 to {_MAX_GAUSSIANS} Gaussians, got {text!r}")
    return int(text)


def _to_integers(values: NDArray[Any], dtype: DTypeLike) -> NDArray[Any]:
    """Convert to integers, clipped to the type's range, because a float near its limit would overflow."""
    limits = np.iinfo(np.dtype(dtype))
    return np.clip(values.astype(np.float64), limits.min, limits.max).astype(dtype)


def _fill(rows: NDArray[Any], names: tuple[str, ...], values: NDArray[Any]) -> None:
    for column, name in enumerate(names):
        rows[name] = values[:, column]


def _stack(raw: dict[str, NDArray[Any]], names: tuple[str, ...]) -> Float32[ndarray, "n k"]:
    return np.stack([raw[name].astype(np.float32) for name in names], axis=1)
