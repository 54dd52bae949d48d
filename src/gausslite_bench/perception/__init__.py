"""Benchmark of perception against ground-truth regions."""
