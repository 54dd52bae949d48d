"""The GPU backend: gsplat's kernels behind the rasterizer interface, with all training data on the device."""

from gausslite.render.cuda.rasterizer import CudaRasterizer

__all__ = ["CudaRasterizer"]
