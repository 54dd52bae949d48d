"""Estimates of what a recording does not state: depth registration, pose error and exposure error."""
