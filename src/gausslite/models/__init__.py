"""Model files on the user's disk: catalogue, download, verification and inspection."""
