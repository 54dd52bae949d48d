"""The trainable splat table, its encoding, learning rates and density control, for mapping and joint refinement."""
