"""Benchmarks of the rasterizers."""
