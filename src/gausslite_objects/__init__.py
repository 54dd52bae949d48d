"""The memory of objects: their life over views and missions, changes between visits, edits, and a team's objects."""
