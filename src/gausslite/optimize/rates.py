"""How fast Adam moves a map that has little time: shared by mapping and refinement."""

from __future__ import annotations

from dataclasses import replace

from gausslite.render.rasterizer import AdamSettings

ONLINE_RATES = AdamSettings(means=2e-4, log_scales=4e-2, quats=8e-3, opacity_logits=5e-2, rgb=2e-2)
"""Adam's rates when a Gaussian is to be trained in some dozens of iterations: 8 times the customary ones for shape and
colour, twice for the means. With the customary ones seeds that start small never grow and blend: on a real kitchen
(320x240, 8 iterations a frame) these gave +1.7 dB in the task's region, and as much to uniform mapping. A
refinement of 500 iterations gains as well: +0.2 dB in the region, +1.0 dB over the whole image of the simulated home.
"""

REFINE_RATES = replace(ONLINE_RATES, decay_after_updates=20)
"""The same for a joint refinement, which ends: what is left of its last large steps stays in the map. So Gaussians
settle from their 20th update on, wherever the views are from. On a real kitchen whose frames two robots shared, that
gave 0.9 dB in the region (fitted views), on simulated homes 0.2 dB.
"""
