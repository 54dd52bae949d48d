"""Benchmark of perception."""
