"""Quality study: every policy maps the same frames at the same budget; held-out views score the maps."""
