"""Read recordings of the app Record3D (iPhone and iPad): an .r3d file, or the folder that it unzips to.

The metadata is JSON. Sources: the app's author in the issues of github.com/marek-simonik/record3d: 27, 33 and 36
(poses), 83 and 99 (intrinsics of each frame), 93 (files) and 108 (depth is aligned to colour, whose intrinsics these
are).
"""

from __future__ import annotations

import json
import re
import weakref
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from jaxtyping import Float32, Float64
from numpy import ndarray
from numpy.typing import NDArray

from gausslite.datasets.camera_files import FolderCamera
from gausslite.datasets.files import DepthUnits, RgbdImage, decode_image, require_pixel_count, resize_depth, resize_rgbd
from gausslite.datasets.folder import FolderReader, FolderSource, estimate_up, is_lost
from gausslite.datasets.pose_track import pose_from_quaternion
from gausslite.datasets.source import excluded_frames_note, require_position
from gausslite.domain.camera import Camera
from gausslite.domain.errors import DatasetError, InvalidInputError
from gausslite.domain.file_formats import foreign_file
from gausslite.domain.frame import Frame
from gausslite.domain.pose import Trajectory, UpAxis, unit_up_axis
from gausslite_recorders.numbered_folder import require_frames

METADATA = "metadata"
_COLOUR_NAME = re.compile(r"rgbd/(\d{1,7})\.jpg")
_MAX_FILE_BYTES = 1 << 28
_UNCOMPRESSED, _LZVN, _LZFSE, _END = b"bvx-", b"bvxn", b"bvx2", b"bvx$"


class Record3dFiles:
    """The files by their names in the recording, such as "rgbd/0.jpg". Raises DatasetError."""

    def __init__(self, path: Path) -> None:
        self._path, self._zip = path, None
        if path.is_dir():
            return
        try:
            self._zip = zipfile.ZipFile(path)
        except (zipfile.BadZipFile, OSError) as error:
            raise DatasetError(
                f"{path}: expected an .r3d file, which is a ZIP; {foreign_file(path) or error}"
            ) from None
        weakref.finalize(self, self._zip.close)

    def path_of(self, name: str) -> str:
        """Return the file's name for messages."""
        return str(self._path / name)

    def colour_numbers(self) -> list[int]:
        """Return the numbers of the colour images, ascending."""
        if self._zip is None:
            names = [f"rgbd/{path.name}" for path in (self._path / "rgbd").glob("*.jpg")]
        else:
            names = self._zip.namelist()
        return sorted(int(match.group(1)) for match in map(_COLOUR_NAME.fullmatch, names) if match)

    def has(self, name: str) -> bool:
        """True if the recording has this file."""
        return (self._path / name).is_file() if self._zip is None else name in self._zip.NameToInfo

    def read(self, name: str) -> bytes:
        """Return a file's bytes. Raises DatasetError if it is missing, damaged or too large."""
        if not self.has(name):
            raise DatasetError(f"{self.path_of(name)}: expected this file of a Record3D recording, got none")
        try:
            file = self._path / name
            size_bytes = file.stat().st_size if self._zip is None else self._zip.getinfo(name).file_size
            if size_bytes > _MAX_FILE_BYTES:
                raise DatasetError(f"{file}: expected at most {_MAX_FILE_BYTES} bytes, got {size_bytes}")
            return file.read_bytes() if self._zip is None else self._zip.read(name)
        except (zipfile.BadZipFile, zlib.error, OSError, EOFError, RuntimeError, NotImplementedError) as error:
            raise DatasetError(f"{self.path_of(name)}: expected a readable file; {error}") from None

    def read_array(self, name: str, dtype: type[np.generic], count: int) -> NDArray[Any]:
        """Return the `count` little-endian values of an LZFSE file.

        The size that the file declares is checked before it is decompressed. Raises DatasetError, also without the
        extra `record3d`.
        """
        data, location = self.read(name), self.path_of(name)
        expected_bytes = count * np.dtype(dtype).itemsize
        declared_bytes = _declared_bytes(data)
        if declared_bytes != expected_bytes:
            got = "bytes of another format" if declared_bytes is None else f"{declared_bytes} bytes"
            raise DatasetError(f"{location}: expected {expected_bytes} bytes, compressed with LZFSE, got {got}")
        lzfse = _lzfse(location)
        try:
            values = lzfse.decompress(data)
        except lzfse.error as error:
            raise DatasetError(f"{location}: expected undamaged LZFSE data; {error}") from None
        if len(values) != expected_bytes:
            raise DatasetError(f"{location}: expected {expected_bytes} bytes, compressed with LZFSE, got {len(values)}")
        return np.frombuffer(values, np.dtype(dtype).newbyteorder("<")).astype(dtype)


def _lzfse(location: str) -> Any:
    try:
        import lzfse
    except ImportError:
        raise DatasetError(
            f"{location}: a Record3D recording needs the extra `record3d`; install it with: pip install "
            "'gausslite[record3d]'"
        ) from None
    return lzfse


def _declared_bytes(data: bytes) -> int | None:
    """Return the sum of the blocks' uncompressed sizes; None for bytes that are no sequence of LZFSE blocks.

    Source: lzfse_internal.h of the reference implementation. A block is a magic number, its uncompressed size, fields
    by its type, and its payload.
    """
    total_bytes = offset = 0
    while (magic := data[offset : offset + 4]) != _END:
        raw_bytes = _unsigned(data, offset + 4, 4)
        if magic == _UNCOMPRESSED:
            block_bytes = 8 + raw_bytes
        elif magic == _LZVN:
            block_bytes = 12 + _unsigned(data, offset + 8, 4)
        elif magic == _LZFSE:
            first, second, third = (_unsigned(data, offset + at, 8) for at in (8, 16, 24))
            block_bytes = (third & 0xFFFFFFFF) + (first >> 20 & 0xFFFFF) + (second >> 40 & 0xFFFFF)
        else:
            return None
        if block_bytes < 8:
            return None
        total_bytes, offset = total_bytes + raw_bytes, offset + block_bytes
    return total_bytes


def _unsigned(data: bytes, offset: int, size_bytes: int) -> int:
    return int.from_bytes(data[offset : offset + size_bytes], "little")


_FOCAL_AND_CENTRE = (0, 4, 6, 7)
"""Places of fx, fy, cx and cy in the 9 numbers of K, which are column-major."""
_MAX_TIME_S = 9e9


@dataclass(frozen=True, slots=True, eq=False)
class Record3dMetadata:
    """What the metadata states; poses: rows of qx qy qz qw px py pz, camera to world with OpenGL axes.

    camera: of the first frame. intrinsics: fx fy cx cy of each frame, or no row. depth_size: (width, height) of the
    depth images, or None. times_s: of each frame, or empty; frames then follow each other at rate_hz.
    """

    camera: Camera
    intrinsics: Float64[ndarray, "n 4"]
    poses: Float64[ndarray, "m 7"]
    times_s: Float64[ndarray, " k"]
    rate_hz: float
    depth_size: tuple[int, int] | None

    @classmethod
    def parse(cls, location: str, data: bytes) -> Record3dMetadata:
        """Return the content of a metadata file. Raises DatasetError with the location."""
        try:
            fields = json.loads(data)
        except (ValueError, RecursionError) as error:
            raise DatasetError(f"{location}: expected JSON; {str(error)[:120]}") from None
        if not isinstance(fields, dict):
            raise DatasetError(f"{location}: expected a JSON object, got {type(fields).__name__}")
        width_px, height_px = _size(location, fields, "w", "h")
        K = _numbers(location, fields, "K", (9,))
        times_s = _numbers(location, fields, "frameTimestamps", (-1,), ())
        if (np.diff(times_s) <= 0).any() or np.abs(times_s).max(initial=0.0) > _MAX_TIME_S:
            raise DatasetError(f"{location}: frameTimestamps: expected ascending times in seconds")
        rate_hz = float(_numbers(location, fields, "fps", (), 30))
        if rate_hz <= 0:
            raise DatasetError(f"{location}: fps: expected a positive number, got {rate_hz:g}")
        return cls(
            _camera(f"{location}: K", K[list(_FOCAL_AND_CENTRE)], width_px, height_px),
            _numbers(location, fields, "perFrameIntrinsicCoeffs", (-1, 4), ()),
            _numbers(location, fields, "poses", (-1, 7), ()),
            times_s,
            rate_hz,
            _size(location, fields, "dw", "dh") if "dw" in fields or "dh" in fields else None,
        )

    def camera_at(self, location: str, number: int) -> Camera:
        """Return the camera of a frame: the image stabiliser and the focus change it a little. Raises DatasetError."""
        if number >= len(self.intrinsics):
            return self.camera
        return _camera(location, self.intrinsics[number], self.camera.width_px, self.camera.height_px)

    def time_ns(self, number: int) -> int:
        """Return a frame's time."""
        seconds = float(self.times_s[number]) if number < len(self.times_s) else number / self.rate_hz
        return round(seconds * 1e9)


def _camera(location: str, intrinsics: Float64[ndarray, "4"], width_px: int, height_px: int) -> Camera:
    """Return the camera; ARKit counts the principal point from the image's corner, as Camera does."""
    try:
        fx_px, fy_px, cx_px, cy_px = intrinsics.tolist()
        return Camera(fx_px, fy_px, cx_px, cy_px, width_px, height_px)
    except InvalidInputError as error:
        raise DatasetError(f"{location}: {error}") from None


def _size(location: str, fields: Mapping[str, Any], width_name: str, height_name: str) -> tuple[int, int]:
    width_px, height_px = (int(_numbers(location, fields, name, ())) for name in (width_name, height_name))
    require_pixel_count(f"{location}: {width_name}, {height_name}", width_px, height_px)
    return width_px, height_px


def _numbers(
    location: str, fields: Mapping[str, Any], name: str, shape: tuple[int, ...], default: Any = None
) -> Float64[ndarray, "..."]:
    """Return a field as finite numbers of this shape, -1 for any length. Raises DatasetError."""
    value = fields.get(name, default)
    expected = f"{location}: {name}: expected finite numbers" + (f" of shape {shape}" if shape else "")
    try:
        array = np.array(value, np.float64)
    except (ValueError, TypeError):
        raise DatasetError(f"{expected}, got {str(value)[:60]!r}") from None
    if array.size == 0 and shape:
        array = array.reshape([max(side, 0) for side in shape])
    fits = array.ndim == len(shape) and all(side in (-1, got) for side, got in zip(shape, array.shape, strict=True))
    if not fits or not np.isfinite(array).all():
        raise DatasetError(f"{expected}, got {'nothing' if value is None else str(value)[:60]}")
    return array


_FILE_ENDING = ".r3d"
_OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
_FIRST_VIEW_UP = (0.0, 1.0, 0.0)
_LOW_CONFIDENCE = 0


class Record3dSource(FolderSource):
    """Frames rgbd/N.jpg with rgbd/N.depth: float32 in metres, compressed with LZFSE, aligned to colour.

    Depth images are smaller than colour; each colour pixel gets the nearest depth pixel. Pixels whose confidence in
    rgbd/N.conf is low (0) have no depth. Images without depth or pose are excluded. The world is the first camera's.
    Sources of the layout: `record3d_metadata` and `record3d_files`. Raises DatasetError, PoseError.
    """

    def __init__(self, path: Path, up_axis: UpAxis | None = None, require_poses: bool = True) -> None:
        super().__init__(path)
        self._files = Record3dFiles(path)
        self._metadata_path = self._files.path_of(METADATA)
        self._metadata = Record3dMetadata.parse(self._metadata_path, self._files.read(METADATA))
        self._require_poses = require_poses
        recorded = self._files.colour_numbers()
        self._recorded = len(recorded)
        self._numbers = [n for n in recorded if self._files.has(f"rgbd/{n}.depth") and self._may_use(n)]
        require_frames(path, len(self._numbers), "rgbd/0.jpg ... with .depth files and poses in metadata")
        self._set_camera(FolderCamera(self._metadata.camera, units_per_metre=1.0), DepthUnits(1.0))
        rotations = np.array([self._read_pose(n)[:3, :3] for n in self._numbers])
        self._up_axis = unit_up_axis(up_axis or estimate_up(rotations, _FIRST_VIEW_UP))

    @staticmethod
    def recognises(path: Path) -> bool:
        """True for an .r3d file, and for a folder with the files of one."""
        if path.is_dir():
            return (path / METADATA).is_file() and (path / "rgbd").is_dir()
        return path.suffix.lower() == _FILE_ENDING and path.is_file()

    @property
    def name(self) -> str:
        """Name of the file or folder without its ending."""
        return self._folder.name.removesuffix(_FILE_ENDING)

    @property
    def depth_registered(self) -> bool:
        """True: the app aligns depth to colour."""
        return True

    @property
    def excluded_frames(self) -> str:
        """Message on the colour images without depth or pose."""
        return excluded_frames_note(self._recorded - len(self), self._recorded, "without depth or pose")

    def __len__(self) -> int:
        return len(self._numbers)

    def frame(self, i: int, size: tuple[int, int] | None = None) -> Frame:
        """Return the frame at position i. Raises DatasetError, PoseError."""
        require_position(self.name, i, len(self))
        number = self._numbers[i]
        name = f"rgbd/{number}.jpg"
        bgr = decode_image(self._files.path_of(name), self._files.read(name), cv2.IMREAD_COLOR)
        camera = self._metadata.camera_at(f"{self._metadata_path}: perFrameIntrinsicCoeffs {number}", number)
        if bgr.shape[:2] != (camera.height_px, camera.width_px):
            expected = f"{camera.width_px}x{camera.height_px}"
            got = f"{bgr.shape[1]}x{bgr.shape[0]}"
            raise DatasetError(f"{self._files.path_of(name)}: expected the size in metadata, {expected}, got {got}")
        depth_m = resize_depth(self._read_depth(number), (camera.width_px, camera.height_px))
        image = resize_rgbd(RgbdImage(np.ascontiguousarray(bgr[..., ::-1]), depth_m, camera), size)
        return image.frame(number, self._metadata.time_ns(number), self._read_pose(number))

    def indices(self) -> Sequence[int]:
        """Return the numbers in the file names."""
        return list(self._numbers)

    def trajectory(self) -> Trajectory:
        """Return the poses at the frames' times."""
        times_ns = np.array([self._metadata.time_ns(number) for number in self._numbers])
        return Trajectory(times_ns / 1e9, np.array([self._read_pose(number) for number in self._numbers]))

    def _may_use(self, number: int) -> bool:
        return not self._require_poses or self._has_pose(number)

    def _has_pose(self, number: int) -> bool:
        if number >= len(self._metadata.poses):
            return False
        row = self._metadata.poses[number]
        return not is_lost(row[4:], row[:4])

    def _read_pose(self, number: int) -> Float64[ndarray, "4 4"]:
        if not self._has_pose(number):
            return np.eye(4)
        row = self._metadata.poses[number]
        return pose_from_quaternion(f"{self._metadata_path}: poses {number}", row[4:], row[:4]) @ _OPENGL_TO_OPENCV

    def _read_depth(self, number: int) -> Float32[ndarray, "h w"]:
        """Return the recorded depth image, 0 where invalid or of low confidence. Raises DatasetError."""
        width, height = self._depth_size()
        name, confidence_name = f"rgbd/{number}.depth", f"rgbd/{number}.conf"
        depth_m = self._files.read_array(name, np.float32, width * height)
        depth_m[~(np.isfinite(depth_m) & (depth_m > 0))] = 0.0
        # recordings of the front camera have no confidence
        if self._files.has(confidence_name) and self._files.read(confidence_name):
            depth_m[self._files.read_array(confidence_name, np.uint8, width * height) == _LOW_CONFIDENCE] = 0.0
        return depth_m.reshape(height, width)

    def _depth_size(self) -> tuple[int, int]:
        if self._metadata.depth_size is None:
            raise DatasetError(f"{self._metadata_path}: expected the size of the depth images, dw and dh, got none")
        return self._metadata.depth_size


RECORD3D: Final = FolderReader(Record3dSource, "Record3D (metadata, rgbd/0.jpg)", f"an {_FILE_ENDING} file")
"""The reader of the group `gausslite.sources`."""
