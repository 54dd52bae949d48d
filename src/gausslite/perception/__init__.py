"""From a frame and a task graph to a relevance map: which pixels the task is about (Sec. III-B.2 to III-B.4)."""
