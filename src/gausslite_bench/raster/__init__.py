"""Benchmarks of the rasterizer."""
