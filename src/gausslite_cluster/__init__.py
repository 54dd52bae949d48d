"""Fusion servers that share a mission in one PostgreSQL database."""
