"""Images without lens and shutter, and estimates of what a recording does not state: registration, errors of poses."""
