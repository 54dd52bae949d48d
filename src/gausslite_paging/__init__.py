"""A map that is larger than memory: what no camera sees lies on disk."""
