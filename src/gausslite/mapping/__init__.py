"""Grow and train one robot's map, with its detail where the task needs it (Sec. III-C and III-D)."""
