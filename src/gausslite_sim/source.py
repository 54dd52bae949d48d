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
from gausslite.domain.arguments import require_size
from gausslite.domain.camera import Camera
from gausslite.domain.errors import DatasetError
from gausslite.domain.frame import Frame
from gausslite.domain.lens import Lens
from gausslite.domain.pose import UpAxis, unit_up_axis
from gausslite.domain.region import Region
from gausslite.domain.trajectory import Trajectory
from gausslite_sim.exposure import camera_gain
from gausslite_sim.home_catalogue import HOME_COUNT, plan_home
from gausslite_sim.home_plan import HomePlan
from gausslite_sim.instance_regions import InstanceImageCache, InstanceRegion
from gausslite_sim.rolling_shutter import render_rolling_view
from gausslite_sim.scene import HomeScene, require_ray_caster
from gausslite_sim.sensor import colour_image, noisy_colour, noisy_depth
from gausslite_sim.view import View, render_view

TRAJECTORY_COUNT = 3
_RATE_HZ = 30
_SUBSTEPS = 8
_FOCAL_PER_WIDTH = 0.85
_SIDES_PX = (16, 4096)
_NUMBERS = ("seed", "trajectory", "frames")
_STRENGTHS = ("noise", "holes", "flying", "exposure", "gloss")


@dataclass(frozen=True, slots=True)
class HomeSettings:
    """One trajectory through one home.

    noise: scale of the sensor model; 0 disables it, and depth is exact. holes and flying: scales of missing depth and
    of flying pixels. exposure: scale of the gain drift. gloss: scale of reflections. shutter_ms: readout time of a
    rolling shutter. speed_deg_s: mean angular speed, which sets the frame rate; 0 for 30 Hz.
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
    shutter_ms: float = 0.0
    speed_deg_s: float = 0.0

    def __post_init__(self) -> None:
        low, high = _SIDES_PX
        for name, value, expected, valid in (
            ("seed", self.seed, "0 to 4294967295", 0 <= self.seed < 2**32),
            ("trajectory", self.trajectory, f"0 to {TRAJECTORY_COUNT - 1}", 0 <= self.trajectory < TRAJECTORY_COUNT),
            ("frames", self.frames, "1 to 100000", 1 <= self.frames <= 100_000),
            ("size", self.size_px, f"sides of {low} to {high} px", all(low <= side <= high for side in self.size_px)),
            ("shutter", self.shutter_ms, "0ms to 100ms", 0.0 <= self.shutter_ms <= 100.0),
            ("speed", self.speed_deg_s, "0 to 1000 degrees per second", 0.0 <= self.speed_deg_s <= 1000.0),
            *((name, getattr(self, name), "0 to 10", 0.0 <= getattr(self, name) <= 10.0) for name in _STRENGTHS),
        ):
            if not valid:
                raise DatasetError(f"{self.world}: {name}: expected {expected}, got {value}")

    @property
    def world(self) -> str:
        """The home's name in a spec."""
        return _world(self.home)

    @classmethod
    def parse(cls, query: str, home: int = 0) -> HomeSettings:
        """Parse "seed=0&trajectory=1&frames=120&size=320x240&noise=1"; all parts are optional. Raises DatasetError."""
        settings: dict[str, Any] = {}
        for key, value in parse_qsl(query, keep_blank_values=True):
            if key in _NUMBERS and re.fullmatch(r"[0-9]{1,10}", value):
                settings[key] = int(value)
            elif key in _STRENGTHS and re.fullmatch(r"[0-9]{1,3}(\.[0-9]{1,9})?", value):
                settings[key] = float(value)
            elif key == "size" and (match := re.fullmatch(r"([0-9]{1,5})x([0-9]{1,5})", value)):
                settings["size_px"] = (int(match.group(1)), int(match.group(2)))
            elif key == "shutter" and (match := re.fullmatch(r"([0-9]{1,3}(?:\.[0-9]{1,3})?)ms", value)):
                settings["shutter_ms"] = float(match.group(1))
            elif key == "speed" and re.fullmatch(r"[0-9]{1,4}", value):
                settings["speed_deg_s"] = float(value)
            else:
                expected = "&".join(
                    [
                        *(f"{name}=N" for name in _NUMBERS),
                        *("size=WxH", "shutter=Xms", "speed=N"),
                        *(f"{name}=X" for name in _STRENGTHS),
                    ]
                )
                raise DatasetError(
                    f"{_world(home)}: {key}={value}: expected {expected}, each of them optional; N whole, X 0 to 10"
                )
        return cls(home, **settings)


def _world(home: int) -> str:
    return f"sim:home-{home}" if home else "sim:home"


@dataclass(frozen=True, slots=True, eq=False)
class _BuiltHome:
    """A home with its scene, and its objects' regions by name."""

    plan: HomePlan
    scene: HomeScene
    regions: Mapping[str, Region]


_build_lock = threading.Lock()


@lru_cache(maxsize=2)
def _build_home(home: int, seed: int) -> _BuiltHome:
    """Return the home, shared by all sources of the process; call it with `_build_lock` held."""
    plan = plan_home(home, seed)
    scene = HomeScene(plan)
    images = InstanceImageCache(scene)
    regions = {name: InstanceRegion(name, scene.names.index(name), images) for name in scene.object_names}
    return _BuiltHome(plan, scene, regions)


class SimulatedHome:
    """A trajectory through a home, with z up. Frames are deterministic on every machine.

    Frame numbers run from 0 to frames - 1, with timestamps at 30 Hz. The first request for a frame or region builds
    the home, which takes seconds. Raises DatasetError without the extra `sim`.
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
        """Home, seed and trajectory."""
        settings = self._settings
        return f"{settings.world.replace(':', '-')}-{settings.seed}-{settings.trajectory}"

    @property
    def camera(self) -> Camera:
        """A horizontal field of view of 61 degrees."""
        return self._camera

    @property
    def lens(self) -> Lens | None:
        """None: the camera is a pinhole."""
        return None

    @property
    def up_axis(self) -> UpAxis:
        """Z."""
        return self._up_axis

    @property
    def depth_registered(self) -> bool:
        """True: one camera renders both images."""
        return True

    @property
    def excluded_frames(self) -> str:
        """Empty: every frame is used."""
        return ""

    def __len__(self) -> int:
        return self._settings.frames

    def frame(self, i: int, size: tuple[int, int] | None = None) -> Frame:
        """Return the frame at position i, resized to (width_px, height_px). Raises DatasetError."""
        require_position(self.name, i, len(self))
        if size is not None:
            require_size("size", size)
        settings, home, T_world_camera = self._settings, self._home, self._poses[i]
        view = self._apply_exposure(self._render(i), i)
        if settings.noise > 0:
            rng = np.random.default_rng([settings.seed, settings.trajectory, i])
            noise = home.plan.sensor.scaled(settings.holes, settings.flying)
            rgb = noisy_colour(view, noise, settings.noise, rng)
            depth_m = noisy_depth(view, noise, settings.noise, rng)
        else:
            rgb, depth_m = colour_image(view.rgb), view.depth_m
        image = resize_rgbd(RgbdImage(rgb, depth_m, self._camera), size)
        return Frame(
            i,
            round(self._times_s[i] * 1e9) if settings.speed_deg_s else i * 10**9 // _RATE_HZ,
            image.rgb,
            image.depth_m,
            image.camera,
            T_world_camera.copy(),
        )

    def indices(self) -> Sequence[int]:
        """0 to frames - 1."""
        return range(len(self))

    def trajectory(self) -> Trajectory:
        """Return the exact poses at the frames' times."""
        return Trajectory(self._times_s, self._poses)

    def regions(self) -> Mapping[str, Region]:
        """Return the region of every object by name: table, chair_1, mug, ...; without walls, floors and ceilings."""
        return dict(self._home.regions)

    @cached_property
    def _home(self) -> _BuiltHome:
        with _build_lock:
            return _build_home(self._settings.home, self._settings.seed)

    @cached_property
    def _poses(self) -> Float64[ndarray, "n 4 4"]:
        return self._home.plan.trajectories[self._settings.trajectory](self._settings.frames)

    @cached_property
    def _times_s(self) -> Float64[ndarray, " n"]:
        """Capture times: at 30 Hz, or at the rate that gives the mean angular speed of the settings."""
        numbers, speed_deg_s = np.arange(len(self), dtype=np.float64), self._settings.speed_deg_s
        if speed_deg_s == 0:
            return numbers / _RATE_HZ
        turn_per_frame_deg = np.degrees(Trajectory(numbers, self._poses).angular_speeds_rad_s().mean())
        return numbers * (max(float(turn_per_frame_deg), 1e-6) / speed_deg_s)

    @cached_property
    def _fine_trajectory(self) -> Trajectory:
        """The trajectory with _SUBSTEPS poses per frame, for the velocity at a frame."""
        count = _SUBSTEPS * (len(self) - 1) + 1
        times_s = np.interp(np.arange(count) / _SUBSTEPS, np.arange(len(self)), self._times_s)
        return Trajectory(times_s, self._home.plan.trajectories[self._settings.trajectory](count))

    def _render(self, i: int) -> View:
        settings, scene, T_world_camera = self._settings, self._home.scene, self._poses[i]
        if settings.shutter_ms == 0:
            return render_view(scene, self._camera, T_world_camera, settings.gloss)
        twist = self._fine_trajectory.twist(_SUBSTEPS * i)
        readout_s = settings.shutter_ms / 1e3
        return render_rolling_view(scene, self._camera, T_world_camera, twist, readout_s, settings.gloss)

    def _apply_exposure(self, view: View, i: int) -> View:
        """Return the view with the simulated exposure."""
        drift = self._settings.exposure * self._home.plan.exposure_drift
        if drift == 0:
            return view
        return replace(view, rgb=view.rgb * camera_gain(i / len(self), drift, self._settings.trajectory))


def open_simulated(spec: str, up_axis: UpAxis | None = None) -> Source:
    """Return the source of a spec without "sim:": "home", "home-3" or "home-3?seed=0&...". Raises DatasetError."""
    world, _, query = spec.partition("?")
    name = re.fullmatch(r"home(?:-([1-9]))?", world)
    home = int(name.group(1) or 0) if name else HOME_COUNT + 1
    if home > HOME_COUNT:
        raise DatasetError(f"sim:{world}: expected sim:home, or one of sim:home-1 to sim:home-{HOME_COUNT}")
    return SimulatedHome(HomeSettings.parse(query, home), up_axis)
