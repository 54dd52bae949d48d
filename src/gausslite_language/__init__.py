"""Parse a task sentence into a graph of targets, anchors and relations (Sec. III-B.1)."""
