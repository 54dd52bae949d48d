"""Chaos run of a fusion server: kills, partitions and a full disk while agents send, checked bit for bit."""
