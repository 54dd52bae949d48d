"""Writers of libraries that report no full disk: an incomplete file is an error, and it is removed."""

import resource
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from test_formats import plate
from test_video import CAMERA, turned

from gausslite.codec.run_files import KeyframeView
from gausslite.domain.errors import StorageError
from gausslite.render.rasterizer import Rendering
from gausslite_export.occupancy import OccupancySettings, write_octomap
from gausslite_export.video import write_video


@contextmanager
def largest_file(size_bytes: int) -> Iterator[None]:
    """Refuse to write beyond this size, as a full disk does; Python ignores the signal that comes with it."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size_bytes, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def noise(camera: object, T_world_camera: np.ndarray) -> Rendering:
    rng = np.random.default_rng(int(1000 * T_world_camera[0, 3]))
    return Rendering(rng.random((48, 64, 3), np.float32), *np.ones((2, 48, 64), np.float32), None)


def test_a_video_cut_short_is_an_error(tmp_path: Path) -> None:
    views = [KeyframeView(i, i, CAMERA, turned(0.0, i / 4), 5) for i in range(4)]
    with largest_file(2000), pytest.raises(StorageError, match="expected a video of 30 frames, got 0; check the disk"):
        write_video(tmp_path / "map.mp4", views, noise, seconds=1.0)
    assert not list(tmp_path.iterdir())


def test_an_octomap_cut_short_is_an_error(tmp_path: Path) -> None:
    with largest_file(100), pytest.raises(StorageError, match="check the disk's free space"):
        write_octomap(tmp_path / "map.bt", plate(0.525), OccupancySettings(voxel_m=0.02))
    assert not list(tmp_path.iterdir())
