"""The GPU backend: gsplat's kernels under the seam's image model, with everything kept on the device in training."""

from gausslite.render.cuda.rasterizer import CudaRasterizer

__all__ = ["CudaRasterizer"]
