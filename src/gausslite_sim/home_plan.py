"""Description of a home before its scene is built: objects, textures, lighting, trajectories and sensor."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from gausslite.domain.errors import DatasetError
from gausslite_sim.lighting import Lighting
from gausslite_sim.mesh import Vector
from gausslite_sim.scene_objects import Item, place_parts
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

    def with_changes(self, changes: Mapping[str, Vector | None]) -> HomePlan:
        """Return the plan with these objects shifted, in metres, or left out. Raises DatasetError for unknown names."""
        names = {item.name for item in self.items if not item.is_structure}
        unknown = sorted(changes.keys() - names)
        if unknown:
            raise DatasetError(f"changes: expected objects among {', '.join(sorted(names))}, got {', '.join(unknown)}")
        items = []
        for item in self.items:
            shift_m = changes.get(item.name, (0.0, 0.0, 0.0))
            if shift_m is not None:
                items.append(replace(item, parts=place_parts(item.parts, shift_m)) if any(shift_m) else item)
        return replace(self, items=items)
