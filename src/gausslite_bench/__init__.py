"""Benchmarks and quality studies of GaussLite."""
