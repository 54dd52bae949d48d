"""Benchmark of a team: the fused maps of several agents by strategy and policy."""
