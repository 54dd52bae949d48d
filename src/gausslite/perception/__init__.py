"""Estimate the relevance map of a frame for a task graph (Sec. III-B.2 to III-B.4)."""
