"""The eight benchmark homes: furnished rooms with the clutter of real homes and offices."""
