"""Adapter that measures an external rasterizer library on the same splats and view, through its C functions.

The library uses the same splat rows and Adam moments as GaussLite. Its images are planes padded to whole tiles of 16
pixels. It exports gl_new, gl_free, gl_setup, gl_forward, gl_set_grad, gl_backward, gl_pbwd and gl_step.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from gausslite.domain.errors import KernelError
from gausslite.mapping.splat_table import SplatTable
from gausslite.render.rasterizer import ROW_WIDTH, TILE_PX
from gausslite_bench.raster.procedural_room import BenchView

_FUSED_L1, _L1_AND_SSIM = 1, 2
_PLANES = 5
_CACHE_LINE_BYTES = 64
_POINTER, _INT, _FLOAT = ctypes.c_void_p, ctypes.c_int, ctypes.c_float
_FUNCTIONS = {
    "gl_new": (_POINTER, (_INT,)),
    "gl_free": (None, (_POINTER,)),
    "gl_setup": (None, (_POINTER, _POINTER, _INT, _INT, _POINTER, _INT)),
    "gl_forward": (None, (_POINTER, _POINTER, _INT, _POINTER)),
    "gl_set_grad": (None, (_POINTER, _POINTER)),
    "gl_backward": (None, (_POINTER,)),
    "gl_pbwd": (None, (_POINTER, _POINTER, _POINTER)),
    "gl_step": (
        ctypes.c_double,
        (_POINTER, _POINTER, _INT, *[_POINTER] * 3, _FLOAT, _FLOAT, *[_POINTER] * 3, _INT, _INT),
    ),
}


class ExternalRasterizer:
    """One benchmark case in the library; learning rates are zero, so the splats do not change."""

    def __init__(self, library: Path, threads: int, table: SplatTable, view: BenchView) -> None:
        """Load the library and copy the view. Raises KernelError if the library lacks the functions."""
        self._lib = _load(library)
        self._table = table
        self._image = _planes(view.rgb.transpose(2, 0, 1).astype(np.float32) / np.float32(255.0))
        self._depth = _planes(view.depth_m[None])
        height, width = self._depth.shape[1:]
        self._image_gradients = _aligned((_PLANES, height, width))
        self._image_gradients[:4] = 1e-5
        self._row_gradients = _aligned((table.count, ROW_WIDTH))
        self._rates = _aligned((ROW_WIDTH,))
        camera = view.camera
        intrinsics = (camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px)
        pose = view.T_camera_world
        self._camera = np.concatenate([pose[:3, :3].ravel(), pose[:3, 3], intrinsics]).astype(np.float32)
        self._size_px = camera.width_px, camera.height_px
        self._threads = threads
        self._handle = ctypes.c_void_p()

    @contextmanager
    def active(self) -> Iterator[None]:
        """Create the library's threads and memory for the block only: idle threads would disturb other measurements."""
        self._handle = ctypes.c_void_p(self._lib.gl_new(self._threads))
        try:
            self._lib.gl_setup(self._handle, self._camera.ctypes.data, *self._size_px, None, 0)
            yield
        finally:
            self._lib.gl_free(self._handle)

    def fused_l1(self) -> None:
        """Run one whole iteration with L1 on colour and depth."""
        self._step(_FUSED_L1)

    def fused_l1_ssim(self) -> None:
        """Run one whole iteration with L1 and SSIM."""
        self._step(_L1_AND_SSIM)

    def forward(self) -> None:
        """Render the image."""
        self._lib.gl_forward(self._handle, self._table.rows.ctypes.data, self._table.count, None)

    def backward(self) -> None:
        """Compute the gradients of the rows from those of the image; call `forward` first."""
        self._lib.gl_set_grad(self._handle, self._image_gradients.ctypes.data)
        self._lib.gl_backward(self._handle)
        self._lib.gl_pbwd(self._handle, self._table.rows.ctypes.data, self._row_gradients.ctypes.data)

    def _step(self, mode: int) -> None:
        table = self._table
        # in the order of the library's function
        arguments = (
            self._handle,
            table.rows.ctypes.data,
            table.count,
            None,
            self._image.ctypes.data,
            self._depth.ctypes.data,
            1.0,
            1.0,
            table.first_moment.ctypes.data,
            table.second_moment.ctypes.data,
            self._rates.ctypes.data,
            1,
            mode,
        )
        self._lib.gl_step(*arguments)


def _load(library: Path) -> ctypes.CDLL:
    try:
        # dlopen would search the system's libraries for a bare file name
        lib = ctypes.CDLL(str(library.resolve()))
        for name, (result_type, argument_types) in _FUNCTIONS.items():
            function = getattr(lib, name)
            function.restype, function.argtypes = result_type, argument_types
    except (OSError, AttributeError) as reason:
        raise KernelError(f"{library}: expected a shared library with {', '.join(_FUNCTIONS)}; {reason}") from None
    return lib


def _planes(images: Float32[ndarray, "c h w"]) -> Float32[ndarray, "c hp wp"]:
    """Return the planes padded with zeros to whole tiles."""
    count, height, width = images.shape
    padded = _aligned((count, -(-height // TILE_PX) * TILE_PX, -(-width // TILE_PX) * TILE_PX))
    padded[:, :height, :width] = images
    return padded


def _aligned(shape: tuple[int, ...]) -> ndarray:
    """Return float32 zeros aligned to a cache line."""
    size = int(np.prod(shape)) * 4
    memory = np.zeros(size + _CACHE_LINE_BYTES, np.uint8)
    start = -memory.ctypes.data % _CACHE_LINE_BYTES
    return memory[start : start + size].view(np.float32).reshape(shape)
