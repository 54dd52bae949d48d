"""The oracle: the image model written plainly in float64 torch, slow and easy to check."""

from gausslite.render.reference.rasterizer import ReferenceRasterizer

__all__ = ["ReferenceRasterizer"]
