"""The fusion server: keeps the team's map, and serves it to whoever wants to see it."""
