"""Benchmark of one agent's mapping loop: time, memory, and quality lost to a frame rate."""
