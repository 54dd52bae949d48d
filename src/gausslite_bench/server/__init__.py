"""Benchmark of the fusion server under the load of many agents."""
