"""The camera's poses in a bag: from tf between a world frame and the camera, or from a topic of poses."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from jaxtyping import Float64
from numpy import ndarray

from gausslite.datasets.pose_track import PoseTrack
from gausslite.datasets.ros.address import BagOptions
from gausslite.datasets.ros.bag_file import BagFile
from gausslite.datasets.ros.messages import frame_name, quaternion_of, stamp_ns, translation_of
from gausslite.datasets.ros.realsense_recording import stream_transforms
from gausslite.datasets.ros.transform_tree import TransformTree, track_of, transforms_of
from gausslite.domain.errors import DatasetError

TF, TF_STATIC = "/tf", "/tf_static"
_ODOMETRY = "nav_msgs/msg/Odometry"
_POSE_TYPES = (
    _ODOMETRY,
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/TransformStamped",
)
_WORLD_FRAMES = ("odom", "map", "world")
"""Preferred in this order: odometry is continuous, localisation in a map is corrected in jumps."""


@dataclass(frozen=True, slots=True, eq=False)
class TreePoses:
    """Poses of a camera in a world frame, from the transforms between them."""

    tree: TransformTree
    world: str
    camera: str

    def at(self, time_s: float) -> Float64[ndarray, "4 4"] | None:
        """Return T_world_camera; None without transforms near this time. Raises DatasetError, PoseError."""
        return self.tree.at(self.world, self.camera, time_s)

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

    def __str__(self) -> str:
        """Return where the poses come from."""
        return f"{self.track.location}, the pose of {self.body}"


CameraPoses = TreePoses | TopicPoses


def read_tree(bag: BagFile) -> TransformTree:
    """Return the frames of /tf_static and /tf, or of a RealSense recording. Raises DatasetError."""
    transforms = stream_transforms(bag)
    for topic, static in ((TF_STATIC, True), (TF, False)):
        for message in bag.messages(topic):
            transforms += transforms_of(message.transforms, static)
    return TransformTree(transforms)


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
    for world in (*(name for name in _WORLD_FRAMES if name in ancestors), ancestors[-1]):
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
        poses[stamp_ns(message.header)] = _pose(message)
        if not body:
            body = frame_name(getattr(message, "child_frame_id", ""))
    if not poses:
        raise DatasetError(f"{bag.path}: {topic}: expected poses, got no message")
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
