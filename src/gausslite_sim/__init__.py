"""Simulated homes: textured rooms with named objects, a noisy RGB-D camera and exact poses.

`gausslite_sim.source.open_simulated` opens a home as a Source; `gausslite` finds it for sources named sim:...
"""
