"""Model files: catalogue, download, checks, inspection, and the networks that they hold."""
