"""Adam's learning rates for mapping and for joint refinement."""

from __future__ import annotations

from dataclasses import replace

from gausslite.render.rasterizer import AdamSettings

ONLINE_RATES = AdamSettings(means=2e-4, log_scales=4e-2, quats=8e-3, opacity_logits=5e-2, rgb=2e-2)
"""Learning rates for Gaussians with a few dozen iterations. Those of shape and colour are 8 times the 3DGS rates,
those of the means twice. With the 3DGS rates small seeds do not grow enough to blend. On a real kitchen
(320x240, 8 iterations per frame) these rates gain 1.7 dB in the region of interest, and as much for uniform
mapping. A refinement of 500 iterations gains 0.2 dB in the region and 1.0 dB over the whole image of the
simulated home.
"""

REFINE_RATES = replace(ONLINE_RATES, decay_after_updates=20)
"""The same rates with decay from the 20th update of a Gaussian on. A joint refinement ends, and its last large steps
would remain as noise. The decay gains 0.9 dB in the region (fitted views) on a real kitchen with the frames of two
robots, and 0.2 dB on simulated homes.
"""
