"""Read standard 3DGS PLY files, and write them, binary little-endian with three additional columns.

Columns: x y z | f_dc_0..2 = (rgb - 0.5) / C0 | opacity as logit | scale_0..2 as log | rot_0..3 = w x y z | additional:
active, kappa, target. All columns are float, because common readers read a row as a run of floats; so kappa is exact
up to 2^24. The reader takes all formats of PLY and finds columns by name, in any order and type. It ignores other
tools' columns (normals) and elements; the additional ones may be missing (then inactive, kappa 0, no target).
f_rest_0 to f_rest_{3k-1}: coefficients of the k spherical harmonics of degree 1 to 3, first all of red (`StoredMap`).
An opacity of ±infinity is 1 or 0, a scale of -infinity is flat. The header may name the map's world frame:
`comment world_frame NAME`, in ASCII, other characters percent-encoded.
"""

from __future__ import annotations

import contextlib
import itertools
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO
from urllib.parse import quote, unquote

import numpy as np
from jaxtyping import Float32
from numpy import ndarray
from numpy.lib.recfunctions import structured_to_unstructured
from numpy.typing import DTypeLike, NDArray

from gausslite.codec.state_file import write_atomic
from gausslite.domain.checks import require_name
from gausslite.domain.errors import InvalidInputError, MapFileError
from gausslite.domain.file_formats import FOREIGN_BYTES, foreign_format
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.relevance import NO_TARGET

SH_C0 = 0.28209479177387814
HARMONICS = "colours that depend on the view (spherical harmonics above degree 0)"
_MAX_GAUSSIANS = 100_000_000
_MAX_HEADER_BYTES = 1 << 16
_WORLD_FRAME_COMMENT = "comment world_frame "
# opacities of 0 and 1 would have infinite logits
_OPACITY_EDGE = 1e-6
_NORMALS = "nx", "ny", "nz"  # 3DGS writes them as zeros
_POSITIONS, _COLOURS = ("x", "y", "z"), ("f_dc_0", "f_dc_1", "f_dc_2")
_SCALES, _ROTATIONS = ("scale_0", "scale_1", "scale_2"), ("rot_0", "rot_1", "rot_2", "rot_3")
_STANDARD = (*_POSITIONS, *_COLOURS, "opacity", *_SCALES, *_ROTATIONS)
_EXTRAS = ("active", "kappa", "target")
_REST = "f_rest_"
_REST_COUNTS = (9, 24, 45)
"""Of the columns of degree 1, 2 and 3."""
_PLY_TYPES = {
    **{"char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2"},
    **{"ushort": "u2", "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4"},
    **{"float": "f4", "float32": "f4", "double": "f8", "float64": "f8"},
}
_ASCII = "ascii"
_BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", _ASCII: "<"}
_PRINTABLE = "".join(chr(code) for code in range(0x20, 0x7F) if chr(code) != "%")


@dataclass(frozen=True, slots=True, eq=False)
class StoredMap:
    """The content of a PLY file.

    harmonics: coefficients of the spherical harmonics above degree 0 for each channel; k is 0, 3, 8 or 15.
    """

    gaussians: Gaussians
    world_frame: str  # empty for an unnamed one
    harmonics: Float32[ndarray, "n 3 k"]
    left_out: int = 0  # how many rows are left out
    reason: str = ""  # why they are left out, in words
    unused: tuple[str, ...] = ()  # columns that say what a map here does not hold

    @property
    def notes(self) -> tuple[str, ...]:
        """What is left out of the file, one line each."""
        total = self.left_out + len(self.gaussians)
        rows = f"left out {self.left_out} of {total} Gaussians: {self.reason}" if self.left_out else ""
        columns = f"left out {len(self.unused)} columns that no map here has: {', '.join(self.unused[:3])}"
        if len(self.unused) > 3:
            columns += ", …"
        return tuple(filter(None, (rows, columns if self.unused else "")))


def write_ply(
    path: Path, gaussians: Gaussians, world_frame: str = "", harmonics: Float32[ndarray, "n 3 k"] | None = None
) -> None:
    """Write the map atomically; the header names the world frame unless it is empty.

    Raises InvalidInputError for a name with line breaks or control characters, StorageError if writing fails.
    """
    write_atomic(path, ply_bytes(gaussians, world_frame, harmonics))


def write_ply_parts(path: Path, count: int, parts: Iterable[Gaussians], world_frame: str = "") -> None:
    """Write the map whose parts have so many Gaussians, one part after the other. Raises as `write_ply`."""
    header = _header(count, _rows(Gaussians.empty()), world_frame)
    write_atomic(path, itertools.chain([header], (_rows(part).tobytes() for part in parts)))


def read_ply(path: Path, warn: Callable[[str], object] = warnings.warn) -> Gaussians:
    """Read a map without harmonics. Rows with NaN, or infinite where no map can be, are left out.

    warn: called with a line on what is left out. Raises MapFileError naming the file and the cause.
    """
    stored = read_stored_map(path)
    for note in stored.notes:
        warn(f"{path}: {note}")
    if stored.harmonics.any():
        warn(f"{path}: left out {HARMONICS}: a Gaussian has one colour here; `gausslite render` shows all")
    return stored.gaussians


def read_stored_map(path: Path) -> StoredMap:
    """Read a map and its world frame. Raises MapFileError naming the file and the cause."""
    with _open_map(path) as file:
        return _stored_map(file.read())


def read_world_frame(path: Path) -> str:
    """Read the name of the world frame from a map's header; empty if it has none. Raises MapFileError."""
    with _open_map(path) as file:
        return world_frame_from_ply(file.read(_MAX_HEADER_BYTES))


def ply_bytes(gaussians: Gaussians, world_frame: str = "", harmonics: Float32[ndarray, "n 3 k"] | None = None) -> bytes:
    """Encode the map as the bytes of a PLY file. Raises InvalidInputError as `write_ply`."""
    rows = _rows(gaussians, harmonics)
    return _header(len(rows), rows, world_frame) + rows.tobytes()


def _rows(gaussians: Gaussians, harmonics: Float32[ndarray, "n 3 k"] | None = None) -> NDArray[Any]:
    rest_names = () if harmonics is None else tuple(f"{_REST}{i}" for i in range(3 * harmonics.shape[2]))
    names = (*_POSITIONS, *_COLOURS, *rest_names, "opacity", *_SCALES, *_ROTATIONS, *_EXTRAS)
    rows = np.zeros(len(gaussians), [(name, "<f4") for name in names])
    if harmonics is not None:
        _fill(rows, rest_names, harmonics.reshape(len(gaussians), len(rest_names)))
    opacity = np.clip(gaussians.opacities.astype(np.float64), _OPACITY_EDGE, 1 - _OPACITY_EDGE)
    _fill(rows, _POSITIONS, gaussians.means_m)
    _fill(rows, _COLOURS, ((gaussians.rgb - 0.5) / SH_C0).astype(np.float32))
    _fill(rows, _SCALES, np.log(np.maximum(gaussians.scales_m, np.finfo(np.float32).tiny)))
    _fill(rows, _ROTATIONS, gaussians.quats_wxyz)
    rows["opacity"] = np.log(opacity / (1 - opacity))
    for name in _EXTRAS:
        rows[name] = getattr(gaussians, name)
    return rows


def _header(count: int, rows: NDArray[Any], world_frame: str) -> bytes:
    """Return the header of a file with so many rows like these."""
    require_name("world frame", world_frame)
    header = ["ply", "format binary_little_endian 1.0"]
    if world_frame:
        header.append(_WORLD_FRAME_COMMENT + quote(world_frame, _PRINTABLE))
    header.append(f"element vertex {count}")
    header += [f"property float {name}" for name in rows.dtype.names or ()]
    return ("\n".join([*header, "end_header"]) + "\n").encode("ascii")


def world_frame_from_ply(data: bytes) -> str:
    """Return the world frame named in the header of a PLY file; empty if it has none. Raises MapFileError."""
    end, _ = _header_extent(data)
    comments = {line for line in data[:end].splitlines() if line.startswith(_WORLD_FRAME_COMMENT.encode())}
    if not comments:
        return ""
    if len(comments) > 1:
        raise MapFileError(f"expected one world frame in the header, got {len(comments)}")
    try:
        name = unquote(comments.pop().decode().removeprefix(_WORLD_FRAME_COMMENT), errors="strict")
        require_name("world frame", name)
    except (InvalidInputError, UnicodeDecodeError) as error:
        raise MapFileError(f"expected a world frame's name in the header: {error}") from error
    return name


def gaussians_from_ply(data: bytes) -> Gaussians:
    """Decode the map in the bytes of a PLY file. Raises MapFileError, also for a single row that is no Gaussian."""
    stored = _stored_map(data)
    if stored.left_out:
        raise MapFileError(stored.reason)
    return stored.gaussians


def _stored_map(data: bytes) -> StoredMap:
    """Decode a PLY file; rows that are no Gaussians are left out. Raises MapFileError, also if no row is left."""
    columns, count, unused = _read_columns(data)
    with np.errstate(over="ignore", invalid="ignore"):
        gaussians = _to_gaussians(columns, count)
    converted = np.concatenate(
        [gaussians.means_m, gaussians.rgb, gaussians.opacities[:, None], gaussians.scales_m, gaussians.quats_wxyz],
        axis=1,
    )
    checked = {**dict(zip(_STANDARD, converted.T, strict=True)), **{n: columns[n] for n in _EXTRAS if n in columns}}
    finite = {name: np.isfinite(values) for name, values in checked.items()}
    harmonics = columns[_REST].reshape(count, 3, columns[_REST].shape[1] // 3)
    if harmonics.size:
        finite[_REST] = np.isfinite(harmonics).all(axis=(1, 2))
    broken = [name for name, values in finite.items() if not values.all()]
    if not broken:
        return StoredMap(gaussians, world_frame_from_ply(data), harmonics, unused=unused)
    kept = np.logical_and.reduce(list(finite.values()))
    reason = f"column {broken[0]}: expected finite values, got NaN or infinity"
    if not kept.any():
        raise MapFileError(reason)
    left_out = int(np.count_nonzero(~kept))
    return StoredMap(gaussians.take(kept), world_frame_from_ply(data), harmonics[kept], left_out, reason, unused)


def _to_gaussians(raw: Mapping[str, NDArray[Any]], count: int) -> Gaussians:
    logits = np.clip(raw["opacity"].astype(np.float64), -60, 60)
    return Gaussians(
        means_m=_stack(raw, _POSITIONS),
        quats_wxyz=_stack(raw, _ROTATIONS),
        scales_m=np.maximum(np.exp(_stack(raw, _SCALES)), np.finfo(np.float32).tiny),
        opacities=(1 / (1 + np.exp(-logits))).astype(np.float32),
        rgb=_stack(raw, _COLOURS) * np.float32(SH_C0) + np.float32(0.5),
        active=raw.get("active", np.zeros(count)) != 0,
        kappa=_to_integers(raw.get("kappa", np.zeros(count)), np.uint32),
        target=_to_integers(raw.get("target", np.full(count, NO_TARGET)), np.int16),
    )


@dataclass(frozen=True, slots=True)
class _Element:
    """An element of the header."""

    name: str
    count: int
    fields: dict[str, str]  # type of each column by its name
    has_list: bool = False  # its rows differ in size


def _read_columns(data: bytes) -> tuple[Mapping[str, NDArray[Any]], int, tuple[str, ...]]:
    """Return a map's columns in the file by name, the number of rows, and other columns. Raises MapFileError."""
    file_format, elements, start = _read_header(data)
    names = [element.name for element in elements]
    if "vertex" not in names:
        raise MapFileError(f"expected an element 'vertex', got {', '.join(names) or 'none'}")
    before, vertex = elements[: names.index("vertex")], elements[names.index("vertex")]
    missing = [name for name in _STANDARD if name not in vertex.fields]
    if "packed_position" in vertex.fields:
        raise MapFileError("expected a 3DGS map, got a compressed PLY; `gausslite export --to ply` unpacks it")
    if missing:
        raise MapFileError(f"expected the columns of a 3DGS map, missing {', '.join(missing)}")
    present = [name for name in (*_STANDARD, *_EXTRAS) if name in vertex.fields]
    rest = [f"{_REST}{i}" for i in range(sum(name.startswith(_REST) for name in vertex.fields))]
    if len(rest) not in _REST_COUNTS or not vertex.fields.keys() >= set(rest):
        rest = []
    unused = tuple(name for name in vertex.fields if name not in {*present, *rest, *_NORMALS})
    if file_format == _ASCII:
        table = _ascii_rows(data[start:], sum(element.count for element in before), vertex)
        places = {name: place for place, name in enumerate(vertex.fields)}
        harmonics = table[:, [places[name] for name in rest]].astype(np.float32)
        return {**{name: table[:, places[name]] for name in present}, _REST: harmonics}, vertex.count, unused
    for element in (*before, vertex):
        if element.has_list:
            raise MapFileError(f"element {element.name}: expected columns of one size up to the vertices, got a list")
    order = _BYTE_ORDERS[file_format]
    row, *earlier = (_row_type(element, order) for element in (vertex, *before))
    start += sum(element.count * earlier_row.itemsize for element, earlier_row in zip(before, earlier, strict=True))
    if len(data) - start < vertex.count * row.itemsize:
        got = f"{max(len(data) - start, 0)} bytes of them"
        raise MapFileError(f"expected {vertex.count} Gaussians of {row.itemsize} bytes, got {got}")
    rows = np.frombuffer(data, row, vertex.count, start)
    harmonics = structured_to_unstructured(rows[rest], np.float32) if rest else np.zeros((vertex.count, 0), np.float32)
    return {**{name: rows[name] for name in present}, _REST: harmonics}, vertex.count, unused


def _row_type(element: _Element, byte_order: str) -> np.dtype[np.void]:
    return np.dtype([(name, byte_order + kind) for name, kind in element.fields.items()])


def _ascii_rows(text: bytes, skipped: int, vertex: _Element) -> NDArray[Any]:
    """Return the numbers of the vertices' rows, which follow this many rows of other elements. Raises MapFileError."""
    lines = [line for line in text.splitlines() if line.strip()][skipped : skipped + vertex.count]
    if len(lines) < vertex.count:
        raise MapFileError(f"expected {vertex.count} rows of Gaussians, got {len(lines)}")
    numbers = np.zeros((0, len(vertex.fields)))
    with contextlib.suppress(ValueError):  # not a number, or rows of different lengths
        numbers = np.array([[float(field) for field in line.split()] for line in lines], np.float64)
    if vertex.has_list or numbers.size != vertex.count * len(vertex.fields):
        raise MapFileError(f"expected rows of {len(vertex.fields)} numbers, got other rows")
    return numbers.reshape(vertex.count, len(vertex.fields))


def _read_header(data: bytes) -> tuple[str, list[_Element], int]:
    """Return the format, the elements, and the first row's offset."""
    end, start = _header_extent(data)
    lines = [line.split() for line in data[:end].decode("ascii", "replace").splitlines()[1:]]
    lines = [line for line in lines if line and line[0] not in ("comment", "obj_info")]
    file_format = " ".join(lines[0]) if lines else "nothing"
    kind = lines[0][1] if lines and len(lines[0]) == 3 and (lines[0][0], lines[0][2]) == ("format", "1.0") else ""
    if kind not in _BYTE_ORDERS:
        raise MapFileError(f"expected a format of {', '.join(_BYTE_ORDERS)} 1.0, got {file_format}")
    elements: list[_Element] = []
    for line in lines[1:]:
        if line[0] == "element" and len(line) == 3 and line[1] not in [element.name for element in elements]:
            elements.append(_Element(line[1], _count(line[2]), {}))
        elif elements and line[:2] == ["property", "list"] and len(line) == 5:
            elements[-1] = replace(elements[-1], has_list=True)
        elif elements and line[0] == "property" and len(line) == 3 and line[1] in _PLY_TYPES:
            if line[2] in elements[-1].fields:
                raise MapFileError(f"expected 'property TYPE NAME' once per column, got {' '.join(line)!r} again")
            elements[-1].fields[line[2]] = _PLY_TYPES[line[1]]
        else:
            expected = "'element NAME COUNT' or 'property TYPE NAME' once per column"
            raise MapFileError(f"expected {expected}, got {' '.join(line)!r}")
    return kind, elements, start


def _header_extent(data: bytes) -> tuple[int, int]:
    """Return the offsets of the header's last line and of the first row."""
    end = data.find(b"\nend_header", 0, _MAX_HEADER_BYTES) + 1
    if not data.startswith(b"ply") or end == 0:
        raise MapFileError(f"expected a PLY file, got {foreign_format(data[:FOREIGN_BYTES]) or 'something else'}")
    start = data.find(b"\n", end, end + 12) + 1
    if start == 0:
        raise MapFileError("the header has no end")
    return end, start


@contextlib.contextmanager
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
    return np.clip(np.nan_to_num(values.astype(np.float64)), limits.min, limits.max).astype(dtype)


def _fill(rows: NDArray[Any], names: tuple[str, ...], values: NDArray[Any]) -> None:
    for column, name in enumerate(names):
        rows[name] = values[:, column]


def _stack(raw: Mapping[str, NDArray[Any]], names: tuple[str, ...]) -> Float32[ndarray, "n k"]:
    return np.stack([raw[name].astype(np.float32) for name in names], axis=1)
