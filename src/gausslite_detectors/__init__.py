"""Detectors and segmenters from the model files of a user."""
