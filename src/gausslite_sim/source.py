"""Simulated homes as Sources: sim:home-3?seed=0&trajectory=0&frames=120&size=320x240&noise=1."""

from __future__ import annotations

import re
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Final

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.datasets.files import RgbdImage, resize_rgbd
from gausslite.datasets.source import Source, require_position
from gausslite.domain.camera import Camera
from gausslite.domain.checks import require_size
from gausslite.domain.errors import DatasetError
from gausslite.domain.frame import Frame
from gausslite.domain.pose import Trajectory, UpAxis, unit_up_axis
from gausslite.domain.relevance import Region
from gausslite_sim.exposure import camera_gain
from gausslite_sim.home_catalogue import HOME_COUNT, plan_home
from gausslite_sim.home_plan import HomePlan
from gausslite_sim.home_settings import HomeSettings
from gausslite_sim.instance_regions import InstanceImageCache, InstanceRegion
from gausslite_sim.moving_box import box_centre_m, with_box
from gausslite_sim.odometry_drift import drifting_poses
from gausslite_sim.ray_camera import RayCamera
from gausslite_sim.read_ahead import ReadAhead
from gausslite_sim.recorded_view import RecordingCamera, render_recorded_view
from gausslite_sim.scene import HomeScene, ray_caster_factory
from gausslite_sim.sensor import colour_image, noisy_colour, noisy_depth
from gausslite_sim.trajectory import TrajectorySampler, walked_laps
from gausslite_sim.view import View, render_view

_RATE_HZ = 30
_FOCAL_PER_WIDTH = 0.85


@dataclass(frozen=True, slots=True, eq=False)
class _BuiltHome:
    """A home with its scene, and its objects' regions by name."""

    plan: HomePlan
    scene: HomeScene
    regions: Mapping[str, Region]


_build_lock = threading.Lock()


@lru_cache(maxsize=2)
def _build_home(home: int, seed: int, changes: tuple[tuple[str, tuple[float, float, float] | None], ...]) -> _BuiltHome:
    """Return the home, shared by all sources of the process; call it with `_build_lock` held."""
    plan = plan_home(home, seed).with_changes(dict(changes))
    scene = HomeScene(plan)
    images = InstanceImageCache(scene)
    regions = {name: InstanceRegion(name, scene.names.index(name), images) for name in scene.object_names}
    return _BuiltHome(plan, scene, regions)


class SimulatedHome(Source):
    """A trajectory through a home, with z up. Frames are deterministic on every machine. No file states its lens.

    Frame numbers run from 0 to frames - 1, with timestamps at 30 Hz. The first request for a frame or region builds
    the home, which takes seconds. Raises DatasetError without the extra `sim`.
    """

    def __init__(self, settings: HomeSettings, up_axis: UpAxis | None = None) -> None:
        ray_caster_factory()
        width, height = settings.size_px
        self._settings = settings
        self._camera = Camera.centred(_FOCAL_PER_WIDTH * width, width, height)
        self._up_axis = unit_up_axis(up_axis or (0.0, 0.0, 1.0))

    @property
    def name(self) -> str:
        """Home, seed and trajectory."""
        settings = self._settings
        return f"{settings.home_name.replace(':', '-')}-{settings.seed}-{settings.trajectory}"

    @property
    def camera(self) -> Camera:
        """A horizontal field of view of 61 degrees."""
        return self._camera

    @property
    def up_axis(self) -> UpAxis:
        """Up in the world frame; by default the z axis."""
        return self._up_axis

    @property
    def depth_registered(self) -> bool:
        """True: one camera renders both images."""
        return True

    @property
    def camera_ideal(self) -> bool:
        """True unless the settings have a lens, a rolling shutter or motion blur."""
        settings = self._settings
        return settings.lens is None and settings.readout_ms == 0 and settings.exposure_ms == 0

    @property
    def poses_exact(self) -> bool:
        """True unless the settings have an odometry that drifts."""
        return self._settings.drift_percent == 0

    @property
    def depth_unit_stated(self) -> bool:
        """True: metres."""
        return True

    @property
    def world_frame(self) -> str:
        """Home and seed: all trajectories through one home share its frame."""
        return f"{self._settings.home_name.replace(':', '-')}-seed-{self._settings.seed}"

    def __len__(self) -> int:
        return self._settings.frames

    def frame(self, i: int, size: tuple[int, int] | None = None) -> Frame:
        """Return the frame at position i, resized to (width_px, height_px). Raises DatasetError."""
        require_position(self.name, i, len(self))
        if size is not None:
            require_size("size", size)
        image = resize_rgbd(self._images(i), size)
        return Frame(
            i,
            round(self._times_s[i] * 1e9) if self._settings.speed_deg_s else i * 10**9 // _RATE_HZ,
            image.rgb,
            image.depth_m,
            image.camera,
            self._odometry_poses[i].copy(),
            recorded_rgb=image.recorded_rgb,
        )

    def indices(self) -> Sequence[int]:
        """0 to frames - 1."""
        return range(len(self))

    def trajectory(self) -> Trajectory:
        """Return the frames' poses: exact, or those of an odometry that drifts."""
        return Trajectory(self._times_s, self._odometry_poses)

    def regions(self) -> Mapping[str, Region]:
        """Return the region of every object by name: table, chair_1, mug, ...; without walls, floors and ceilings."""
        return dict(self._home.regions)

    def with_true_poses(self) -> Source:
        """Return the sequence without the drift of its odometry."""
        return SimulatedHome(replace(self._settings, drift_percent=0.0), self._up_axis)

    @cached_property
    def _home(self) -> _BuiltHome:
        with _build_lock:
            return _build_home(self._settings.home, self._settings.seed, self._settings.changes)

    @cached_property
    def _poses(self) -> Float64[ndarray, "n 4 4"]:
        return self._path(self._settings.frames)

    @property
    def _path(self) -> TrajectorySampler:
        return walked_laps(self._home.plan.trajectories[self._settings.trajectory], self._settings.laps)

    @cached_property
    def _odometry_poses(self) -> Float64[ndarray, "n 4 4"]:
        settings = self._settings
        if settings.drift_percent == 0:
            return self._poses
        rng = np.random.default_rng([settings.seed, settings.trajectory])
        return drifting_poses(self._poses, settings.drift_percent / 100, rng)

    @cached_property
    def _times_s(self) -> Float64[ndarray, " n"]:
        return np.arange(len(self), dtype=np.float64) * self._interval_s

    @cached_property
    def _interval_s(self) -> float:
        """Time between two frames: that of 30 Hz, or the one that gives the mean angular speed of the settings."""
        speed_deg_s = self._settings.speed_deg_s
        if speed_deg_s == 0:
            return 1.0 / _RATE_HZ
        numbers = np.arange(len(self), dtype=np.float64)
        turn_per_frame_deg = np.degrees(Trajectory(numbers, self._poses).angular_speeds_rad_s().mean())
        return max(float(turn_per_frame_deg), 1e-6) / speed_deg_s

    @cached_property
    def _images(self) -> ReadAhead[RgbdImage]:
        return ReadAhead(self._record, len(self))

    def _record(self, i: int) -> RgbdImage:
        """Return the images of frame i as the simulated camera records them."""
        settings, home = self._settings, self._home
        view = self._apply_exposure(self._render(i), i)
        if settings.noise == 0:
            return RgbdImage(colour_image(view.rgb), view.depth_m, self._camera)
        rng = np.random.default_rng([settings.seed, settings.trajectory, i])
        rgb = noisy_colour(view, home.plan.sensor, settings.noise, rng)
        return RgbdImage(rgb, noisy_depth(view, home.plan.sensor, settings.noise, rng), self._camera)

    def _render(self, i: int) -> View:
        settings, scene = self._settings, self._home.scene
        if settings.readout_ms == 0 and settings.exposure_ms == 0:
            ray_camera = RayCamera(self._camera, self._poses[i], settings.lens)
            view = render_view(scene, ray_camera)
            return with_box(view, ray_camera, box_centre_m(self._poses, i)) if settings.movers else view
        camera = RecordingCamera(self._camera, settings.lens, settings.readout_ms / 1e3, settings.exposure_ms / 1e3)
        path = self._path

        def poses_at(seconds: Float64[ndarray, " n"]) -> Float64[ndarray, "n 4 4"]:
            return path(settings.frames, i + seconds / self._interval_s)

        return render_recorded_view(scene, camera, poses_at)

    def _apply_exposure(self, view: View, i: int) -> View:
        """Return the view with the simulated exposure."""
        amplitude = self._settings.exposure * self._home.plan.exposure_drift
        if amplitude == 0:
            return view
        return replace(view, rgb=view.rgb * camera_gain(i / len(self), amplitude, self._settings.trajectory))


class HomeReader:
    """The SourceReader of simulated homes."""

    layout, address = "", "sim:home"

    def recognises(self, _address: str) -> bool:
        """False: a home has no files."""
        return False

    def open(self, address: str, up_axis: UpAxis | None = None, _require_poses: bool = True) -> Source:
        """Return the source of "home", "home-3" or "home-3?seed=0&...". Raises DatasetError."""
        world, _, query = address.partition("?")
        name = re.fullmatch(r"home(?:-([1-9]))?", world)
        home = int(name.group(1) or 0) if name else HOME_COUNT + 1
        if home > HOME_COUNT:
            raise DatasetError(f"sim:{world}: expected sim:home, or one of sim:home-1 to sim:home-{HOME_COUNT}")
        return SimulatedHome(HomeSettings.parse(query, home), up_axis)


HOMES: Final = HomeReader()
"""The reader of the group `gausslite.sources`."""
