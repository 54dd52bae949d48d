"""A home before it is built: its things, what they look like, its light and the walks through it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from gausslite_sim.lighting import Lighting
from gausslite_sim.scene_objects import Item
from gausslite_sim.sensor_noise import SensorNoise
from gausslite_sim.textures import Texture
from gausslite_sim.trajectory import Trajectory


@dataclass(frozen=True, slots=True, eq=False)
class HomePlan:
    """Everything in the world frame (z up). The last walk sees the same things from places off the others.

    exposure_drift: the most by which the camera's gain strays from 1 on its way.
    """

    seed: int
    items: Sequence[Item]
    textures: dict[str, Texture]
    lighting: Lighting
    trajectories: tuple[Trajectory, ...]
    exposure_drift: float = 0.0
    sensor: SensorNoise = field(default_factory=SensorNoise)
