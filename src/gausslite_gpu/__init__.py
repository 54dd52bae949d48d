"""The GPU backend: gsplat's kernels behind the rasterizer interface, with all training data on the device."""

from gausslite_gpu.rasterizer import CudaRasterizer

__all__ = ["CudaRasterizer"]
