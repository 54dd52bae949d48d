"""Read a recording of NumPy arrays, as `np.savez` writes them to `run.npz`.

rgb [n, h, w, 3] uint8, depth_m [n, h, w] float32, T_world_camera [n, 4, 4], times_ns [n], camera [fx, fy, cx, cy].
"""

import zipfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gausslite.datasets.files import RgbdImage, resize_rgbd
from gausslite.datasets.source import Source, require_position
from gausslite.domain.camera import Camera
from gausslite.domain.errors import DatasetError
from gausslite.domain.frame import Frame
from gausslite.domain.pose import Trajectory, UpAxis

ARRAYS = ("rgb", "depth_m", "T_world_camera", "times_ns", "camera")


class ArrayRecording(Source):
    """A `Source`; what it does not define has the value of a recording that states nothing."""

    def __init__(self, path: Path, up_axis: UpAxis | None) -> None:
        try:
            with np.load(path) as stored:
                self._rgb, self._depth_m, self._poses, self._times_ns, camera = (stored[name] for name in ARRAYS)
            (height, width), (fx, fy, cx, cy) = self._rgb.shape[1:3], map(float, camera)
        except (OSError, KeyError, ValueError, zipfile.BadZipFile) as error:
            raise DatasetError(f"{path}: expected the arrays {', '.join(ARRAYS)}, but {error}") from error
        self._name, self._camera, self._up_axis = path.stem, Camera(fx, fy, cx, cy, width, height), up_axis

    @property
    def name(self) -> str:
        """The file's name without its suffix."""
        return self._name

    @property
    def camera(self) -> Camera:
        """The camera of the file."""
        return self._camera

    @property
    def up_axis(self) -> UpAxis:
        """The user's, or z."""
        return self._up_axis or (0.0, 0.0, 1.0)

    @property
    def depth_registered(self) -> bool:
        """True: the format asks for it."""
        return True

    @property
    def depth_unit_stated(self) -> bool:
        """True: metres."""
        return True

    def __len__(self) -> int:
        return len(self._rgb)

    def frame(self, i: int, size: tuple[int, int] | None = None) -> Frame:
        """Return a frame."""
        require_position(self.name, i, len(self))
        image = resize_rgbd(RgbdImage(self._rgb[i], self._depth_m[i], self.camera), size)
        return image.frame(i, int(self._times_ns[i]), self._poses[i].astype(np.float64))

    def indices(self) -> Sequence[int]:
        """Return the positions: each frame has the number of its row."""
        return range(len(self))

    def trajectory(self) -> Trajectory:
        """Return all poses."""
        return Trajectory(self._times_ns / 1e9, self._poses.astype(np.float64))


class ArrayReader:
    """The `SourceReader` of `.npz` files."""

    layout, address = "", "an .npz recording"

    def recognises(self, address: str) -> bool:
        """Return True for a file with this suffix."""
        return address.endswith(".npz")

    def open(self, address: str, up_axis: UpAxis | None, _: bool) -> ArrayRecording:
        """Return the recording, all of whose frames have a pose."""
        return ArrayRecording(Path(address).expanduser(), up_axis)


READER = ArrayReader()
