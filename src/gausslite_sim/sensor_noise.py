"""Parameters of the structured-light sensor model."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class SensorNoise:
    """Errors at strength 1.

    Axial depth noise: standard deviation base_m + growth_per_m (z - 0.4 m)^2 (Nguyen, Izadi and Lovell 2012, Kinect).
    Disparity steps: 1/disparity_steps_per_px, with focal_times_baseline_px_m; depth steps grow with z^2.
    No return outside [near_m, far_m] and at grazing incidence. Edge pixels lose their depth, or get a depth
    between both sides (flying pixels). dark_loss, gloss_loss: probability of no return from black and glossy
    surfaces. Colour: read-out noise and shot noise.
    """

    base_m: float = 0.0012
    growth_per_m: float = 0.0016
    focal_times_baseline_px_m: float = 43.5
    disparity_steps_per_px: float = 8.0
    near_m: float = 0.35
    far_m: float = 6.0
    edge_loss: float = 0.45
    edge_flight: float = 0.10
    edge_step_m: float = 0.06
    grazing_cosine: float = 0.12
    speckle_loss: float = 0.002
    dark_loss: float = 0.0
    gloss_loss: float = 0.0
    colour_read: float = 1.6
    colour_shot: float = 0.16
