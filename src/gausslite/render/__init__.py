"""Gaussians to pixels and gradients: one protocol, its backends, and the choice between them."""
