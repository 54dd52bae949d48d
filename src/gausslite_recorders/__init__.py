"""Readers of recordings that apps and cameras export: Record3D and ZED."""
