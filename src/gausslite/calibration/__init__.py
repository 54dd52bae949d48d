"""Estimate what the recording does not state: depth registration, pose and exposure errors."""
