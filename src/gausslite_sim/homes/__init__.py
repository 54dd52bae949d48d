"""Eight homes as hard as real ones, each a room that somebody lives or works in."""
