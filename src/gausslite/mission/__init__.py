"""One robot's mission: its settings and options, the loop they build, and what it leaves on disk."""
