"""Description of a home before its scene is built: objects, textures, lighting, trajectories and sensor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from gausslite_sim.lighting import Lighting
from gausslite_sim.scene_objects import Item
from gausslite_sim.sensor_noise import SensorNoise
from gausslite_sim.textures import Texture
from gausslite_sim.trajectory import TrajectorySampler


@dataclass(frozen=True, slots=True, eq=False)
class HomePlan:
    """All data in the world frame (z up). The last trajectory provides held-out views of the same objects.

    exposure_drift: maximum deviation of the camera's gain from 1 along a trajectory.
    """

    seed: int
    items: Sequence[Item]
    textures: dict[str, Texture]
    lighting: Lighting
    trajectories: tuple[TrajectorySampler, ...]
    exposure_drift: float = 0.0
    sensor: SensorNoise = field(default_factory=SensorNoise)
