"""Simulated homes as Sources: sim:home-3?seed=0&trajectory=0&frames=120&size=320x240&noise=1."""

from __future__ import annotations

import re
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any
from urllib.parse import parse_qsl

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.datasets.images import RgbdImage, resize_rgbd
from gausslite.datasets.source import Source, require_position
from gausslite.domain.camera import Camera
from gausslite.domain.frame import Frame
from gausslite.domain.pose import UpAxis, unit_up_axis
from gausslite.domain.region import Region
from gausslite.errors import DatasetError
from gausslite_sim.exposure import camera_gain
from gausslite_sim.home_catalogue import HOME_COUNT, plan_home
from gausslite_sim.home_plan import HomePlan
from gausslite_sim.instance_regions import InstanceImageCache, InstanceRegion
from gausslite_sim.scene import HomeScene, require_ray_caster
from gausslite_sim.sensor import colour_image, noisy_colour, noisy_depth
from gausslite_sim.view import View, render_view

TRAJECTORY_COUNT = 3
_RATE_HZ = 30
_FOCAL_PER_WIDTH = 0.85
_SIDES_PX = (16, 4096)
_NUMBERS = ("seed", "trajectory", "frames")
_STRENGTHS = ("noise", "holes", "flying", "exposure", "gloss")


@dataclass(frozen=True, slots=True)
class HomeSettings:
    """One walk through one home.

    noise scales the whole sensor model, 0 turns it off: depth is then exact. holes and flying scale those of its
    parts, exposure the drift of the camera's gain, gloss what polished surfaces mirror.
    """

    home: int = 0
    seed: int = 0
    trajectory: int = 0
    frames: int = 120
    size_px: tuple[int, int] = (320, 240)
    noise: float = 1.0
    holes: float = 1.0
    flying: float = 1.0
    exposure: float = 1.0
    gloss: float = 1.0

    def __post_init__(self) -> None:
        low, high = _SIDES_PX
        for name, value, wanted, right in (
            ("seed", self.seed, "0 to 4294967295", 0 <= self.seed < 2**32),
            ("trajectory", self.trajectory, f"0 to {TRAJECTORY_COUNT - 1}", 0 <= self.trajectory < TRAJECTORY_COUNT),
            ("frames", self.frames, "1 to 100000", 1 <= self.frames <= 100_000),
            ("size", self.size_px, f"sides of {low} to {high} px", all(low <= side <= high for side in self.size_px)),
            *((name, getattr(self, name), "0 to 10", 0.0 <= getattr(self, name) <= 10.0) for name in _STRENGTHS),
        ):
            if not right:
                raise DatasetError(f"{self.world}: {name}: expected {wanted}, got {value}")

    @property
    def world(self) -> str:
        """The home's name in a spec."""
        return _world(self.home)

    @classmethod
    def parse(cls, query: str, home: int = 0) -> HomeSettings:
        """From "seed=0&trajectory=1&frames=120&size=320x240&noise=1"; what is left out keeps its default."""
        chosen: dict[str, Any] = {}
        for key, value in parse_qsl(query, keep_blank_values=True):
            if key in _NUMBERS and re.fullmatch(r"[0-9]{1,10}", value):
                chosen[key] = int(value)
            elif key in _STRENGTHS and re.fullmatch(r"[0-9]{1,3}(\.[0-9]{1,9})?", value):
                chosen[key] = float(value)
            elif key == "size" and (match := re.fullmatch(r"([0-9]{1,5})x([0-9]{1,5})", value)):
                chosen["size_px"] = (int(match.group(1)), int(match.group(2)))
            else:
                wanted = "&".join([*(f"{name}=N" for name in _NUMBERS), "size=WxH", *(f"{n}=X" for n in _STRENGTHS)])
                raise DatasetError(
                    f"{_world(home)}: {key}={value}: expected {wanted}, each of them optional; N whole, X 0 to 10"
                )
        return cls(home, **chosen)


def _world(home: int) -> str:
    return f"sim:home-{home}" if home else "sim:home"


@dataclass(frozen=True, slots=True, eq=False)
class _Place:
    """A home that stands: what to draw, and its objects by name."""

    plan: HomePlan
    scene: HomeScene
    regions: Mapping[str, Region]


_building = threading.Lock()


@lru_cache(maxsize=2)
def _built(home: int, seed: int) -> _Place:
    """The home of this number and seed, shared by every source of the process; call it with `_building` held."""
    plan = plan_home(home, seed)
    scene = HomeScene(plan)
    images = InstanceImageCache(scene)
    regions = {name: InstanceRegion(name, scene.names.index(name), images) for name in scene.object_names}
    return _Place(plan, scene, regions)


class SimulatedHome:
    """A walk through a home with z up. Every frame is the same whenever and wherever it is asked for.

    Frame numbers run from 0 to frames - 1, times are those numbers at 30 Hz. The home is built, which takes seconds,
    for the first frame or region that is asked for; what is wrong with the settings is told before. Raises
    DatasetError where the extra `sim` is not installed.
    """

    def __init__(self, settings: HomeSettings, up_axis: UpAxis | None = None) -> None:
        require_ray_caster()
        width, height = settings.size_px
        focal = _FOCAL_PER_WIDTH * width
        self._settings = settings
        self._camera = Camera(focal, focal, width / 2, height / 2, width, height)
        self._up_axis = unit_up_axis(up_axis or (0.0, 0.0, 1.0))

    @property
    def name(self) -> str:
        """The home and the walk."""
        settings = self._settings
        return f"{settings.world.replace(':', '-')}-{settings.seed}-{settings.trajectory}"

    @property
    def camera(self) -> Camera:
        """A horizontal field of view of 61 degrees."""
        return self._camera

    @property
    def up_axis(self) -> UpAxis:
        """Z."""
        return self._up_axis

    @property
    def depth_registered(self) -> bool:
        """True: both are drawn by one camera."""
        return True

    @property
    def excluded_frames(self) -> str:
        """Nothing."""
        return ""

    def __len__(self) -> int:
        return self._settings.frames

    def frame(self, i: int, size: tuple[int, int] | None = None) -> Frame:
        """The frame at position i. Raises DatasetError."""
        require_position(self.name, i, len(self))
        settings, place, T_world_camera = self._settings, self._place, self._poses[i]
        view = self._exposed(render_view(place.scene, self._camera, T_world_camera, settings.gloss), i)
        if settings.noise > 0:
            rng = np.random.default_rng([settings.seed, settings.trajectory, i])
            noise = place.plan.sensor.switched(settings.holes, settings.flying)
            rgb = noisy_colour(view, noise, settings.noise, rng)
            depth_m = noisy_depth(view, noise, settings.noise, rng)
        else:
            rgb, depth_m = colour_image(view.rgb), view.depth_m
        image = resize_rgbd(RgbdImage(rgb, depth_m, self._camera), size)
        return Frame(i, i * 10**9 // _RATE_HZ, image.rgb, image.depth_m, image.camera, T_world_camera.copy())

    def indices(self) -> Sequence[int]:
        """0 to frames - 1."""
        return range(len(self))

    def regions(self) -> Mapping[str, Region]:
        """Every object by name: table, chair_1 ..., mug, sofa ...; walls, floors and ceilings are none."""
        return dict(self._place.regions)

    @cached_property
    def _place(self) -> _Place:
        with _building:
            return _built(self._settings.home, self._settings.seed)

    @cached_property
    def _poses(self) -> Float64[ndarray, "n 4 4"]:
        return self._place.plan.trajectories[self._settings.trajectory](self._settings.frames)

    def _exposed(self, view: View, i: int) -> View:
        """The view as a camera takes it whose exposure follows the light."""
        drift = self._settings.exposure * self._place.plan.exposure_drift
        if drift == 0:
            return view
        return replace(view, rgb=view.rgb * camera_gain(i / len(self), drift, self._settings.trajectory))


def open_simulated(spec: str, up_axis: UpAxis | None = None) -> Source:
    """The walk of a spec without its "sim:": "home", "home-3" or "home-3?seed=0&...". Raises DatasetError."""
    world, _, query = spec.partition("?")
    name = re.fullmatch(r"home(?:-([1-9]))?", world)
    home = int(name.group(1) or 0) if name else HOME_COUNT + 1
    if home > HOME_COUNT:
        raise DatasetError(f"sim:{world}: expected sim:home, or one of sim:home-1 to sim:home-{HOME_COUNT}")
    return SimulatedHome(HomeSettings.parse(query, home), up_axis)
