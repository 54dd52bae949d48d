"""Gaussians as bytes: the subset codec for the wire and standard 3DGS PLY for files."""
