"""Encode Gaussians: the subset codec for messages, standard 3DGS PLY and state files on disk."""
