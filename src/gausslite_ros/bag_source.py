"""A bag as a sequence of posed RGB-D frames, with poses from tf or a topic, at the times of the headers."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.datasets.camera_files import FolderCamera, read_camera_file
from gausslite.datasets.folder import FIRST_VIEW_UP, Origin
from gausslite.datasets.pose_track import PoseTrack
from gausslite.datasets.source import (
    Source,
    excluded_frames_note,
    repeated_times_note,
    require_matches,
    require_position,
)
from gausslite.domain.camera import Camera
from gausslite.domain.errors import DatasetError
from gausslite.domain.frame import Frame
from gausslite.domain.lens import Lens
from gausslite.domain.pose import Trajectory, UpAxis, unit_up_axis
from gausslite_ros.bag_file import BagAddress, BagFile, BagOptions, MessageKey, StampedMessage, is_bag_address
from gausslite_ros.cameras import (
    CameraPeriods,
    FrameConverter,
    RgbdCamera,
    join_cameras,
    optical_pose,
    require_own_camera,
)
from gausslite_ros.messages import camera_of, frame_name, quaternion_of, stamp_ns, translation_of
from gausslite_ros.topics import (
    ImageTopic,
    choose_colour,
    choose_depth,
    choose_info,
    depth_units_per_metre,
    image_topics,
    is_aligned,
    stream_transforms,
)
from gausslite_ros.transforms import TransformTree, is_pose, seconds, track_of, transforms_of

_TF_MESSAGE = "tf2_msgs/msg/TFMessage"
_ODOMETRY = "nav_msgs/msg/Odometry"
_POSE_TYPES = (
    _ODOMETRY,
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/TransformStamped",
)
_WORLD_FRAMES = ("odom", "map", "world")
"""Preferred in this order, also as a part of a name: odometry is continuous, a map's localisation has jumps."""


@dataclass(frozen=True, slots=True, eq=False)
class TreePoses:
    """Poses of a camera in a world frame, from the transforms between them."""

    tree: TransformTree
    world: str
    camera: str

    def at(self, time_s: float) -> Float64[ndarray, "4 4"] | None:
        """Return T_world_camera; None without transforms near this time. Raises DatasetError, PoseError."""
        return self.tree.at(self.world, self.camera, time_s)

    @property
    def span_s(self) -> tuple[float, float]:
        """Times of the first and the last pose."""
        return self.tree.span_s(self.world, self.camera)

    def __str__(self) -> str:
        """Return where the poses come from."""
        return f"tf {self.world} → {self.camera}"


@dataclass(frozen=True, slots=True, eq=False)
class TopicPoses:
    """Poses of a body over time from a topic, and the fixed transform from the camera to the body."""

    track: PoseTrack
    tree: TransformTree
    body: str
    camera: str

    def at(self, time_s: float) -> Float64[ndarray, "4 4"] | None:
        """Return T_world_camera; None without a pose near this time. Raises DatasetError, PoseError."""
        T_world_body = self.track.at(time_s)
        if T_world_body is None or self.body == self.camera:
            return T_world_body
        T_body_camera = self.tree.at(self.body, self.camera, time_s)
        return None if T_body_camera is None else T_world_body @ T_body_camera

    @property
    def span_s(self) -> tuple[float, float]:
        """Times of the first and the last pose."""
        return float(self.track.times_s[0]), float(self.track.times_s[-1])

    def __str__(self) -> str:
        """Return where the poses come from."""
        return f"{self.track.location}, the pose of {self.body}"


CameraPoses = TreePoses | TopicPoses


def read_tree(bag: BagFile, colour_topic: str, options: BagOptions) -> TransformTree:
    """Return the frames of tf_static and tf, or of a RealSense recording. Raises DatasetError."""
    transforms = stream_transforms(bag)
    for name, named in (("tf_static", options.tf_static), ("tf", options.tf)):
        topic = _choose_tf(bag, name, named, colour_topic)
        for message in bag.messages(topic) if topic else ():
            transforms += transforms_of(message.transforms, name == "tf_static")
    return TransformTree(transforms)


def _choose_tf(bag: BagFile, name: str, named: str, colour_topic: str) -> str | None:
    """Return the topic of tf that is named, else that of the colour topic's namespace, else the only one.

    Raises DatasetError if the choice is not clear.
    """
    found = [topic for topic, kind in bag.types.items() if kind == _TF_MESSAGE and topic.rpartition("/")[2] == name]
    if named:
        if bag.types.get(named) != _TF_MESSAGE:
            raise DatasetError(
                f"{bag.path}: {name}={named}: expected a topic of {_TF_MESSAGE}, one of {found or 'none'}"
            )
        return named
    around = [topic for topic in found if colour_topic.startswith(topic.removesuffix(name))]
    if around or not found:
        return max(around, key=len, default=None)
    if len(found) > 1:
        raise DatasetError(f"{bag.path}: {len(found)} topics have tf: {', '.join(found)}; choose one with {name}=TOPIC")
    return found[0]


def choose_poses(bag: BagFile, tree: TransformTree, camera: str, options: BagOptions) -> CameraPoses | None:
    """Return the poses of the camera; None if the bag has none.

    The first source that the bag has is used: odom=; tf to frame=; tf to the first of odom, map, world and the root
    that the camera moves in; the only odometry topic. Raises DatasetError if the choice is not clear, and for frames
    that are not connected.
    """
    if options.odom:
        return _topic_poses(bag, tree, camera, options, options.odom)
    if options.frame:
        tree.require_path(options.frame, camera)
        return TreePoses(tree, options.frame, camera)
    ancestors = tree.ancestors(camera)
    known = [frame for name in _WORLD_FRAMES for frame in ancestors if name in re.split("[/_]", frame)]
    for world in (*known, ancestors[-1]):
        if tree.changes_over_time(world, camera):
            return TreePoses(tree, world, camera)
    topics = [topic for topic, message_type in bag.types.items() if message_type == _ODOMETRY]
    if len(topics) > 1:
        raise DatasetError(
            f"{bag.path}: {len(topics)} topics have odometry: {', '.join(topics)}; choose one with odom=TOPIC"
        )
    return _topic_poses(bag, tree, camera, options, topics[0]) if topics else None


def _topic_poses(bag: BagFile, tree: TransformTree, camera: str, options: BagOptions, topic: str) -> TopicPoses:
    message_type = bag.types.get(topic)
    if message_type not in _POSE_TYPES:
        known = [name for name, found in bag.types.items() if found in _POSE_TYPES]
        raise DatasetError(f"{bag.path}: odom={topic}: expected a topic of poses, one of {known or 'none'}")
    poses = {}
    body = options.body
    for message in bag.messages(topic):
        translation_m, quat_xyzw = _pose(message)
        if is_pose(translation_m, quat_xyzw):
            poses[stamp_ns(message.header)] = translation_m, quat_xyzw
        if not body:
            body = frame_name(getattr(message, "child_frame_id", ""))
    if not poses:
        raise DatasetError(f"{bag.path}: {topic}: expected finite poses, got none")
    # a pose without the name of its frame is taken for the camera's own
    body = body or camera
    if body != camera:
        tree.require_path(body, camera)
    return TopicPoses(track_of(f"{bag.path}: {topic}", poses), tree, body, camera)


def _pose(message: Any) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return translation and quaternion (x y z w) of a message of any type of poses."""
    if hasattr(message, "transform"):
        return translation_of(message.transform.translation), quaternion_of(message.transform.rotation)
    pose = message.pose.pose if hasattr(message.pose, "pose") else message.pose
    return translation_of(pose.position), quaternion_of(pose.orientation)


def _no_poses(bag: BagFile, tree: TransformTree, camera: str) -> str:
    """Return what a bag without poses has, and what it may lack."""
    topics = [topic for topic, kind in bag.types.items() if kind == _TF_MESSAGE]
    above = tree.ancestors(camera)
    links = f"tf has only {' → '.join(above)}" if len(above) > 1 else f"tf does not have {camera!r}"
    links += f" ({'; '.join(tree.notes)})" if tree.notes else ""
    return (
        f"expected poses: tf between a world frame and {camera!r}, or an odometry topic, got none: {links}, in "
        f"{' and '.join(topics) or 'no topic'} with {', '.join(tree.frames) or 'no frames'}; tf_static stands at the "
        "start of a recording: if this is a later part of several, give the folder of all parts"
    )


_WORLD_UP = (0.0, 0.0, 1.0)


@dataclass(frozen=True, slots=True, eq=False)
class _Match:
    number: int
    stamp_ns: int
    colour: MessageKey
    depth: MessageKey
    T_world_camera: Float64[ndarray, "4 4"]


class BagSource(Source):
    """The frames of a bag's colour topic, each with the nearest depth image and the camera's pose at its stamp.

    Depth images that are not aligned to colour are registered to it. Colour images without depth or pose are excluded,
    and those with the stamp of the one before.
    Frame numbers are the positions of the colour images by their stamps, from 0. World frames of ROS have z up.
    Raises DatasetError, PoseError, InvalidInputError.
    """

    def __init__(self, address: BagAddress, up_axis: UpAxis | None = None, require_poses: bool = True) -> None:
        self._bag = BagFile(address.path)
        self._options = address.options
        topics = image_topics(self._bag)
        self._colour = choose_colour(self._bag, topics, address.options)
        self._depth = choose_depth(self._bag, topics, self._colour, address.options)
        tree = read_tree(self._bag, self._colour.name, address.options)
        camera_frame = address.options.camera or self._colour.frame
        poses = choose_poses(self._bag, tree, camera_frame, address.options)
        if poses is None and require_poses:
            raise DatasetError(f"{address.path}: {_no_poses(self._bag, tree, camera_frame)}")
        self._poses = poses
        self._require_poses = require_poses
        colours, depths = self._bag.stamps(self._colour.name), self._bag.stamps(self._depth.name)
        self._periods: dict[str, CameraPeriods] = {}
        self._cameras = self._read_cameras(tree, colours[0].stamp_ns)
        unit_m = address.options.depth_unit_m
        stated_units = 1 / unit_m if unit_m else self._cameras.colour.units_per_metre
        units_per_metre = stated_units or depth_units_per_metre(self._bag, self._depth.name)
        self._converter = FrameConverter(self._cameras, self._colour.name, self._depth.name, units_per_metre)
        self._recorded = len(colours)
        self._repeated = sum(a.stamp_ns == b.stamp_ns for a, b in pairwise(colours))
        self._tree_notes = tree.notes
        matches = self._with_first_camera(self._associate(colours, depths))
        tolerance = f"{1000 * self._options.tolerance_s:g} ms"
        times_s = {"colour": seconds(colour.stamp_ns for colour in colours).tolist()}
        times_s["depth"] = seconds(depth.stamp_ns for depth in depths).tolist()
        times_s |= {} if poses is None else {"poses": poses.span_s}
        expected = f"a colour image with a pose, and depth within {tolerance}"
        require_matches(address.path, len(matches), expected, times_s)
        self._origin = Origin.near(np.array([match.T_world_camera[:3, 3] for match in matches]))
        moved = self._origin.moved
        self._matches = [replace(match, T_world_camera=moved(match.T_world_camera)) for match in matches]
        self._up_axis = unit_up_axis(up_axis or (_WORLD_UP if poses is not None else FIRST_VIEW_UP))

    @property
    def name(self) -> str:
        """Name of the file or folder, without the ending of a bag."""
        path = self._bag.path.resolve()
        return path.name if path.is_dir() else path.stem

    @property
    def description(self) -> str:
        """Which topics and poses are used, for a message to the user."""
        depth = "aligned" if self._cameras.depth is None else "registered to colour here; aligned=yes if it is already"
        poses = "none" if self._poses is None else str(self._poses)
        return f"color={self._colour.name}, depth={self._depth.name} ({depth}), poses: {poses}"

    @property
    def camera(self) -> Camera:
        """Colour camera."""
        return self._cameras.camera

    @property
    def lens(self) -> Lens | None:
        """Lens of camera_info for aligned depth; None if colour is undistorted here to register depth to it."""
        return self._cameras.lens

    @property
    def up_axis(self) -> UpAxis:
        """z, as in world frames of ROS, unless the caller gives another; without poses, up in a level first view."""
        return self._up_axis

    @property
    def depth_registered(self) -> bool:
        """True: depth is aligned as recorded, or registered here."""
        return True

    @property
    def depth_unit_stated(self) -> bool:
        """True: ROS defines it, or the bag's address states it."""
        return True

    @property
    def depth_unit_setting(self) -> str:
        """An option of the address."""
        return "depth_unit=Xmm in the address of the bag"

    @property
    def world_frame(self) -> str:
        """Name of the bag, with an origin that is not zero."""
        return self._origin.frame(self.name)

    @property
    def notes(self) -> tuple[str, ...]:
        """Messages on images and transforms that are left out, on parts that are cut, on an origin that is not zero."""
        reason = f"without a pose at their stamp or depth within {1000 * self._options.tolerance_s:g} ms"
        unused = self._recorded - self._repeated - self._other_cameras - len(self)
        unmatched = excluded_frames_note(unused, self._recorded, reason)
        repeated = repeated_times_note(self._repeated, self._recorded)
        others = excluded_frames_note(self._other_cameras, self._recorded, self._other_camera)
        notes = (repeated, unmatched, others, *self._tree_notes, *self._bag.notes, self._origin.note)
        return tuple(filter(None, notes))

    def __len__(self) -> int:
        return len(self._matches)

    def frame(self, i: int, size: tuple[int, int] | None = None) -> Frame:
        """Return the frame at position i. Raises DatasetError."""
        require_position(self.name, i, len(self))
        match = self._matches[i]
        messages = self._bag.read(match.colour), self._bag.read(match.depth)
        location = str(self._bag.path)
        return self._converter.frame(location, match.number, messages, match.stamp_ns, match.T_world_camera, size)

    def indices(self) -> Sequence[int]:
        """Return the positions of the colour images in their topic, from 0."""
        return [match.number for match in self._matches]

    def trajectory(self) -> Trajectory:
        """Return the interpolated pose of every colour image."""
        times_s = seconds(match.stamp_ns for match in self._matches)
        return Trajectory(times_s, np.array([match.T_world_camera for match in self._matches]))

    def _read_cameras(self, tree: TransformTree, first_ns: int) -> RgbdCamera:
        colour = self._read_colour_camera()
        if colour.depth_registered is not None and not self._options.aligned:
            self._options = replace(self._options, aligned="yes" if colour.depth_registered else "no")
        options = self._options
        if is_aligned(options, self._depth.name, self._depth.frame, self._colour.frame):
            return join_cameras(colour, self._read_aligned_camera(colour), np.eye(4), options.axes)
        depth = self._read_camera(self._depth, options.depth_info, "depth_info")
        try:
            T = tree.at(options.camera or self._colour.frame, self._depth.frame, first_ns / 10**9)
        except DatasetError as error:
            raise DatasetError(f"{error}; if depth is aligned to colour, state aligned=yes") from None
        if T is None:
            raise DatasetError(
                f"{self._bag.path}: tf: no transform from {self._depth.frame!r} to {self._colour.frame!r} at the "
                "time of the first colour image; expected it in tf_static, or aligned=yes if depth is aligned to colour"
            )
        if not options.aligned:
            require_own_camera(f"{self._bag.path}: {self._depth.name}", colour, depth, T)
        return join_cameras(colour, depth, T, options.axes)

    def _read_colour_camera(self) -> FolderCamera:
        options = self._options
        if not options.camera_file:
            return self._read_camera(self._colour, options.color_info, "color_info")
        return read_camera_file(Path(options.camera_file).expanduser(), *(self._colour.size or (0, 0)))

    def _read_camera(self, image: ImageTopic, named: str, option: str) -> FolderCamera:
        topic = choose_info(self._bag, image, named, option)
        location = f"{self._bag.path}: {topic}"
        infos = self._bag.contents(topic)
        if not infos:
            raise DatasetError(f"{location}: expected a camera_info message, got none")
        cameras = [camera_of(location, message, image.camera_name) for _, message in infos]
        self._periods[topic] = CameraPeriods(topic, [stamp_ns for stamp_ns, _ in infos], cameras)
        return cameras[0]

    def _read_aligned_camera(self, colour: FolderCamera) -> FolderCamera | None:
        """Return the camera of aligned depth; None if it is colour's, or if the bag does not state it.

        Depth has the stated camera, or is stated to be aligned, if it has colour's size.
        """
        try:
            topic = choose_info(self._bag, self._depth, self._options.depth_info, "depth_info")
        except DatasetError:
            return None
        depth = self._read_camera(self._depth, topic, "depth_info")
        sizes = [(camera.camera.width_px, camera.camera.height_px) for camera in (colour, depth)]
        stated = self._options.aligned or self._options.camera_file
        return None if stated and sizes[0] == sizes[1] else depth

    def _with_first_camera(self, matches: list[_Match]) -> list[_Match]:
        """Return the images taken while every camera_info is that of the start; remember how many others there are."""
        self._other_camera, recorded = "", len(matches)
        for periods in self._periods.values():
            kept = [match for match in matches if periods.is_first(match.stamp_ns)]
            if len(kept) < len(matches):
                self._other_camera, matches = str(periods), kept
        self._other_cameras = recorded - len(matches)
        return matches

    def _associate(self, colours: Sequence[StampedMessage], depths: Sequence[StampedMessage]) -> list[_Match]:
        """Return the colour images with depth and a pose; without poses they get the identity if none is required."""
        depth_ns = np.array([depth.stamp_ns for depth in depths], np.int64)
        matches = []
        for number, colour in enumerate(colours):
            if number and colour.stamp_ns == colours[number - 1].stamp_ns:
                continue
            nearest = int(np.abs(depth_ns - colour.stamp_ns).argmin())
            lag_s = abs(int(depth_ns[nearest]) - colour.stamp_ns) / 10**9
            T = None if self._poses is None else self._poses.at(colour.stamp_ns / 10**9)
            if T is not None:
                T = optical_pose(T, self._options.axes)
            elif not self._require_poses:
                T = np.eye(4)
            if lag_s <= self._options.tolerance_s and T is not None:
                matches.append(_Match(number, colour.stamp_ns, colour.key, depths[nearest].key, T))
        return matches


class BagReader:
    """The SourceReader of bags."""

    layout, address = "", "a ROS bag"

    def recognises(self, address: str) -> bool:
        """True for the path of a bag, with or without options."""
        return is_bag_address(address)

    def open(self, address: str, up_axis: UpAxis | None, require_poses: bool) -> Source:
        """Return the sequence of "PATH?color=TOPIC&...". Raises DatasetError, PoseError, InvalidInputError."""
        return BagSource(BagAddress.parse(address), up_axis, require_poses)


BAGS: Final = BagReader()
"""The reader of the group `gausslite.sources`."""
