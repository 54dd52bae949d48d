"""The memory of objects: their life over views and missions, what changed between two visits, and people's edits."""
