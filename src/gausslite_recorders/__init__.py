"""Readers of recordings in other layouts than that of TUM: 7-Scenes, Replica, Record3D, ZED."""
