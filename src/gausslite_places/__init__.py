"""Recognise a place that was mapped before: describe it, register it, and verify the pose by rendering."""
