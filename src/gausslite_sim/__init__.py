"""Simulated homes: textured rooms with named objects, a noisy RGB-D camera and exact poses.

`gausslite_sim.source.HomeReader` opens a home as a Source; `gausslite` finds it for addresses such as sim:home.
"""
