"""Chaos run of a fusion server: faults of processes, network, clock and disk while agents send, checked bit for bit."""
