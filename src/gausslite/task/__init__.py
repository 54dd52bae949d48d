"""From words to a task graph: what the robot shall map in detail, and what locates it (Sec. III-B.1)."""
