"""The reference backend: the image model in plain float64 torch, slow and easy to check."""

from gausslite.render.reference.rasterizer import ReferenceRasterizer

__all__ = ["ReferenceRasterizer"]
