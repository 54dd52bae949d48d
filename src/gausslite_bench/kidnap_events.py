"""What happens to a robot in `bench kidnaps`: the events, and the frames of a recording before and after each."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.config.option import option
from gausslite.datasets.source import Source
from gausslite.domain.errors import InvalidInputError
from gausslite.domain.frame import Frame
from gausslite.domain.pose import inverse, rotation_angle_deg, transform_of, translation_m
from gausslite.domain.recording import PoseExposurePrior
from gausslite.mission.settings import MissionSettings, default_policy
from gausslite_bench.cli.study_options import one_or_more
from gausslite_bench.quality.real_scenes import REAL_CAMERA

_COVERED_NS = 10_000_000_000
_T_BEGUN = transform_of(np.array([4.0, -3.0, 0.2, 0.0, 0.0, 2.0]))
_NOISE = 2.0
"""Standard deviation of the colours of frames that are shown again, of 255."""
_NEAR_M = 1.0
"""A robot that turns where it stands: frames of the recording are this close to it."""

Frames = Sequence[Frame]
Poses = Float64[ndarray, "4 4"]


def _standing(before: Frame, after: Frames) -> Poses:
    """Return T_odometry_world of an odometry that did not follow the robot from one frame to the others."""
    T_odometry_world: Poses = before.T_world_camera @ inverse(after[0].T_world_camera)
    return T_odometry_world


@dataclass(frozen=True, slots=True)
class Event:
    """The odometry after it, and which frames follow, by their name in `Recording.after`."""

    follow: str
    T_odometry_world: Callable[[Frame, Frames], Poses]
    late_ns: int = 0

    @property
    def is_known(self) -> bool:
        """Whether the map may have the place of the frames that follow."""
        return self.follow not in ("elsewhere", "mirrored")

    def odometry(self, before: Frame, after: Frames) -> Frames:
        """Return the frames that follow with the poses that the odometry gives them."""
        T_odometry_world = self.T_odometry_world(before, after)
        return [
            replace(
                frame,
                T_world_camera=T_odometry_world @ frame.T_world_camera,
                capture_time_ns=frame.capture_time_ns + self.late_ns,
            )
            for frame in after
        ]


EVENTS = {
    "none": Event("way", lambda _before, _after: np.eye(4)),
    "seen": Event("seen", _standing),
    "turned": Event("turned", _standing),
    "unseen": Event("elsewhere", _standing),
    "look-alike": Event("mirrored", _standing),
    "ahead": Event("back", _standing),
    "covered": Event("seen", _standing, _COVERED_NS),
    "restart": Event("way", lambda _before, after: inverse(after[0].T_world_camera)),
    "jump": Event("way", lambda _before, _after: _T_BEGUN),
}
"""none; carried to a place that was seen before, to another recording, to a mirrored place, or ahead, from where the
robot drives back to what it has seen; turned where it stands; covered for ten seconds and carried; odometry
that begins at zero, or jumps, while the robot drives on."""


@dataclass(frozen=True, slots=True)
class KidnapSettings:
    """The options of `bench kidnaps`."""

    source: str = option("sim:home", "the recording", metavar="ADDRESS")
    elsewhere: str = option("sim:home-2", "another one, of a place that the map does not have", metavar="ADDRESS")
    events: tuple[str, ...] = option(
        tuple(EVENTS), f"among {', '.join(EVENTS)}", metavar="A,B", convert=one_or_more(EVENTS)
    )
    objects: tuple[str, ...] = option((), "of the task's region in the recording (default: no region)", metavar="A,B")
    robots: int = option(1, "2: a teammate maps the same place, and a server fuses both maps", low=1, high=2)
    frames: int = option(48, "frames before the event", low=4)
    after: int = option(16, "frames after it", low=2)
    stride: int = option(1, "every n-th frame of the recording", low=1)
    width: int = option(160, "of the images, in pixels", low=64)
    iterations: int = option(8, "of training for each frame", low=0)


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """The frames of both places, with times that go on."""

    source: Source
    elsewhere: Source
    settings: KidnapSettings
    _read: dict[str, Frames] = field(default_factory=dict)

    def __post_init__(self) -> None:
        settings = self.settings
        for source, first in ((self.source, settings.frames), (self.elsewhere, 0)):
            if (needed := (first + settings.after) * settings.stride) > len(source):
                raise InvalidInputError(
                    f"{source.name}: expected at least {needed} frames, got {len(source)}; "
                    "use fewer --frames, --after or a smaller --stride"
                )

    def teammate(self) -> Frames:
        """Return the frames of another robot: from the middle before an event to the last ones that follow."""
        first, end = self.settings.frames // 2, self.settings.frames + self.settings.after
        return self._frames(self.source, range(first, end), 0)

    def mission_settings(self, has_region: bool) -> MissionSettings:
        """Return the settings of each mission."""
        prior = PoseExposurePrior() if self.source.poses_exact else REAL_CAMERA
        return MissionSettings(policy=default_policy(has_region), iterations=self.settings.iterations, pose_prior=prior)

    def before(self) -> Frames:
        """Return the frames before each event."""
        return self._frames(self.source, range(self.settings.frames), 0)

    def after(self, follow: str) -> Frames:
        """Return the frames that follow, those of a place that was seen with other noise."""
        if follow not in self._read:
            self._read[follow] = self._after(follow)
        return self._read[follow]

    def _after(self, follow: str) -> Frames:
        count, after = self.settings.frames, self.settings.after
        if follow == "way":
            return self._frames(self.source, range(count, count + after), count)
        positions = {
            "seen": range(count // 4, count // 4 + after),
            "mirrored": range(count // 4, count // 4 + after),
            "elsewhere": range(after),
            "back": range(count + after - 1, max(count - after, 0) - 1, -1),
        }
        chosen = positions[follow] if follow in positions else self._turned()
        rng = np.random.default_rng(0)
        noisy = [
            replace(frame, rgb=np.clip(frame.rgb + rng.normal(0, _NOISE, frame.rgb.shape), 0, 255).astype(np.uint8))
            for frame in self._frames(self.elsewhere if follow == "elsewhere" else self.source, chosen, count)
        ]
        return list(map(_mirrored, noisy)) if follow == "mirrored" else noisy

    def _turned(self) -> range:
        """Return the frames from the one on that looks away the most, near where the robot stands before the event."""
        poses = self.source.trajectory().T_world_camera[:: self.settings.stride]
        last = poses[self.settings.frames - 1]
        starts = range(len(poses) - self.settings.after + 1)
        near = [i for i in starts if translation_m(poses[i], last) < _NEAR_M]
        start = max(near, key=lambda i: rotation_angle_deg(poses[i], last))
        return range(start, start + self.settings.after)

    def _frames(self, source: Source, positions: range, index: int) -> Frames:
        stride, camera = self.settings.stride, source.camera.narrower(self.settings.width)
        size = camera.width_px, camera.height_px
        step_ns = round(1e9 * stride * float(np.median(np.diff(self.source.trajectory().times_s))))
        frames = (source.frame(position * stride, size) for position in positions)
        return [replace(frame, index=i, capture_time_ns=i * step_ns) for i, frame in enumerate(frames, index)]


def _mirrored(frame: Frame) -> Frame:
    """Return what the camera would record if left and right of the world changed places."""
    mirror = np.diag([-1.0, 1.0, 1.0, 1.0])
    return replace(
        frame,
        rgb=np.ascontiguousarray(frame.rgb[:, ::-1]),
        depth_m=np.ascontiguousarray(frame.depth_m[:, ::-1]),
        camera=frame.camera.mirrored(),
        T_world_camera=mirror @ frame.T_world_camera @ mirror,
    )
