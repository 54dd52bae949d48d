"""All simulated homes by number: 0 is the two-room home of the tests and the demo, 1 to 8 are the benchmark homes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from gausslite_sim import two_room_layout, two_room_trajectories
from gausslite_sim.home_plan import HomePlan
from gausslite_sim.homes import bedroom, kitchen_diner, living_room, lounge, meeting_room, open_office, study, workshop
from gausslite_sim.lighting import Lighting
from gausslite_sim.materials import Painter, paint
from gausslite_sim.scene_objects import Item
from gausslite_sim.sensor_noise import SensorNoise
from gausslite_sim.trajectory import Waypoint, spline_trajectory

_EXPOSURE_DRIFT = 0.12
"""Maximum deviation of the camera's gain from 1 (a factor) along a trajectory."""
_FURNITURE_STREAM = 2
"""Third element of the random seed of a home's furniture."""
_SENSOR = SensorNoise(dark_loss=0.55, gloss_loss=0.5)


@dataclass(frozen=True, slots=True)
class Home:
    """Contents of a module of `homes`."""

    furnish: Callable[[np.random.Generator], Sequence[Item]]
    painters: Callable[[], dict[str, Painter]]
    lighting: Lighting
    trajectories: Sequence[Sequence[Waypoint]]


HOMES = tuple(
    Home(module.furnish, module.painters, module.LIGHTING, module.TRAJECTORIES)
    for module in (living_room, bedroom, kitchen_diner, study, open_office, meeting_room, lounge, workshop)
)
HOME_COUNT = len(HOMES)


def plan_home(number: int, seed: int) -> HomePlan:
    """Return the home of this number, 0 to HOME_COUNT; the seed moves its objects and changes its textures."""
    if number == 0:
        textures = two_room_layout.paint_textures(seed)
        return HomePlan(
            seed, two_room_layout.furnish(seed), textures, two_room_layout.LIGHTING, two_room_trajectories.TRAJECTORIES
        )
    home = HOMES[number - 1]
    items = home.furnish(np.random.default_rng([seed, number, _FURNITURE_STREAM]))
    used = {part.texture for item in items for part in item.parts}
    return HomePlan(
        seed=seed,
        items=items,
        textures=paint(home.painters(), used, seed),
        lighting=home.lighting,
        trajectories=tuple(spline_trajectory(keys) for keys in home.trajectories),
        exposure_drift=_EXPOSURE_DRIFT,
        sensor=_SENSOR,
    )
