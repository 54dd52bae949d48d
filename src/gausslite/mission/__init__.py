"""One robot's mission: its settings, the loop over its frames, checkpoints and results."""
