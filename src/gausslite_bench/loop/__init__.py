"""Benchmarks of the mapping loop."""
