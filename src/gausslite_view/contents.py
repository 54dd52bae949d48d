"""What the page shows at one moment: a coloured map at the detail of the browser, with its start view."""

from __future__ import annotations

import colorsys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum

import cv2
import numpy as np
from jaxtyping import Float32, Float64, Int, Int64, UInt8, UInt32
from numpy import ndarray

from gausslite.codec.run_files import KeyframeView
from gausslite.domain.arrays import require_array
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.objects import ObjectLandmark, ObjectRole
from gausslite.domain.pose import UpAxis, upward_axis
from gausslite.domain.voxels import VoxelGrid
from gausslite_link.map_follower import FollowedMap
from gausslite_view.oriented_box import OrientedBox

NO_AGENT = -1


@dataclass(frozen=True, slots=True)
class AgentPath:
    """The keyframes of one agent of a team, oldest first, in the fused map's frame. colour_index: of the agent."""

    agent: str
    colour_index: int
    keyframes: tuple[KeyframeView, ...]


@dataclass(frozen=True, slots=True, eq=False)
class ViewContents:
    """A map and what belongs to it.

    agent: for each Gaussian an index into agents, NO_AGENT if unknown. targets: noun phrases by Gaussians.target; empty
    for a map of several tasks. T_world_camera: the trajectory, in time order. times_ns: its capture times. paths: those
    of a team's agents. state_ns: the time of this state; without it the trajectory's end.
    """

    gaussians: Gaussians
    agent: Int64[ndarray, " n"]
    agents: tuple[str, ...] = ()
    targets: tuple[str, ...] = ()
    objects: tuple[ObjectLandmark, ...] = ()
    times_ns: Int64[ndarray, " t"] = field(default_factory=lambda: np.zeros(0, np.int64))
    T_world_camera: Float64[ndarray, "t 4 4"] = field(default_factory=lambda: np.zeros((0, 4, 4)))
    keyframes: Sequence[KeyframeView] = ()
    paths: tuple[AgentPath, ...] = ()
    state_ns: int | None = None

    def __post_init__(self) -> None:
        require_array("agent", self.agent, (len(self.gaussians),), np.int64)
        require_array("times_ns", self.times_ns, (None,), np.int64)
        require_array("T_world_camera", self.T_world_camera, (len(self.times_ns), 4, 4), np.float64)

    @property
    def newest_ns(self) -> int | None:
        """The time of this state; None if it is unknown."""
        if self.state_ns is not None:
            return self.state_ns
        return int(self.times_ns[-1]) if len(self.times_ns) else None

    @property
    def up_axis(self) -> UpAxis:
        """The upward direction, by the poses of its cameras."""
        return upward_axis(_poses(self))

    @classmethod
    def of_one_agent(cls, gaussians: Gaussians, agent_id: str = "") -> ViewContents:
        """Return the map of one agent; without a name its Gaussians have no agent."""
        index, agents = (0, (agent_id,)) if agent_id else (NO_AGENT, ())
        return cls(gaussians, np.full(len(gaussians), index, np.int64), agents)


UNASSIGNED_RGB = (110, 110, 118)
"""Colour of Gaussians without agent or object."""
_GOLDEN_RATIO = 0.618034
_FIRST_HUE = 0.08


class ColourMode(StrEnum):
    """What the colour of a Gaussian means."""

    RGB = "RGB"
    KAPPA = "kappa"
    AGENT = "agent"
    OBJECT = "object"


def colours_of(contents: ViewContents, mode: ColourMode) -> UInt8[ndarray, "n 3"]:
    """Return the colour of each Gaussian."""
    gaussians = contents.gaussians
    match mode:
        case ColourMode.RGB:
            rgb: UInt8[ndarray, "n 3"] = (np.clip(gaussians.rgb, 0, 1) * 255 + 0.5).astype(np.uint8)
            return rgb
        case ColourMode.KAPPA:
            return _kappa_colours(gaussians.kappa)
        case ColourMode.AGENT:
            return _category_colours(contents.agent)
        case ColourMode.OBJECT:
            return _category_colours(gaussians.target)


def legend_of(contents: ViewContents, mode: ColourMode) -> list[tuple[str, tuple[int, int, int]]]:
    """Return the names and colours that explain a mode; empty for RGB."""
    match mode:
        case ColourMode.RGB:
            return []
        case ColourMode.KAPPA:
            highest = int(contents.gaussians.kappa.max(initial=0))
            # the colours are logarithmic in kappa, so are the values of the legend
            values = np.unique(np.expm1(np.linspace(0, np.log1p(highest), 5)).round().astype(np.uint32))
            return [(f"kappa {v}", _as_rgb(c)) for v, c in zip(values, _kappa_colours(values, highest), strict=True)]
        case ColourMode.AGENT:
            return _category_legend(contents.agents, contents.agent)
        case ColourMode.OBJECT:
            return _category_legend(contents.targets, contents.gaussians.target)


def category_colour(index: int) -> tuple[int, int, int]:
    """Return the colour of an agent or object; neighbouring indices have clearly different hues."""
    red, green, blue = colorsys.hsv_to_rgb((_FIRST_HUE + index * _GOLDEN_RATIO) % 1.0, 0.75, 0.95)
    return round(255 * red), round(255 * green), round(255 * blue)


def _kappa_colours(kappa: UInt32[ndarray, " n"], highest: int | None = None) -> UInt8[ndarray, "n 3"]:
    top = np.log1p(float(kappa.max(initial=0) if highest is None else highest))
    levels = np.log1p(kappa.astype(np.float64)) / max(top, 1e-9)
    image = (255 * levels + 0.5).astype(np.uint8).reshape(-1, 1)
    if not len(image):
        return np.zeros((0, 3), np.uint8)
    colours: UInt8[ndarray, "n 3"] = cv2.applyColorMap(image, cv2.COLORMAP_VIRIDIS)[:, 0, ::-1].copy()
    return colours


def _category_colours(indices: Int[ndarray, " n"]) -> UInt8[ndarray, "n 3"]:
    count = int(indices.max(initial=NO_AGENT)) + 1
    palette = np.array([*(category_colour(index) for index in range(count)), UNASSIGNED_RGB], np.uint8)
    # index -1 is the palette's last entry
    colours: UInt8[ndarray, "n 3"] = palette[np.maximum(indices, -1)]
    return colours


def _category_legend(names: Sequence[str], indices: Int[ndarray, " n"]) -> list[tuple[str, tuple[int, int, int]]]:
    present = [int(index) for index in np.unique(indices) if index >= 0]
    entries = [(names[i] if i < len(names) else f"number {i}", category_colour(i)) for i in present]
    return entries if len(indices) and indices.min() >= 0 else [*entries, ("none", UNASSIGNED_RGB)]


def _as_rgb(colour: UInt8[ndarray, "3"]) -> tuple[int, int, int]:
    return int(colour[0]), int(colour[1]), int(colour[2])


def with_agents(fused: ViewContents, own: Mapping[str, Gaussians]) -> ViewContents:
    """Return a voted map with the agent of each Gaussian, by the agents' own maps.

    A fused file does not name its winners. A voxel's content came from the agent whose own voxel is most alike in
    number, mean place and mean colour; messages round these by far less than agents differ.
    """
    grid = VoxelGrid()
    keys, rows, features = _voxel_features(fused.gaussians, grid)
    distances = np.full((len(own), len(keys)), np.inf)
    for index, gaussians in enumerate(own.values()):
        own_keys, _, own_features = _voxel_features(gaussians, grid)
        present = np.isin(keys, own_keys)
        others = own_features[np.searchsorted(own_keys, keys[present])]
        distances[index, present] = np.abs(features[present] - others).sum(axis=1)
    owner = np.where(np.isfinite(distances).any(axis=0), distances.argmin(axis=0), NO_AGENT)
    return replace(fused, agent=owner[rows].astype(np.int64), agents=tuple(own))


def _voxel_features(
    gaussians: Gaussians, grid: VoxelGrid
) -> tuple[Int64[ndarray, " v"], Int64[ndarray, " n"], Float64[ndarray, "v 7"]]:
    """Return the voxels, that of each Gaussian, and logarithm of the number, mean place in voxels, and mean colour."""
    keys, rows, counts = np.unique(grid.keys(gaussians.means_m), return_inverse=True, return_counts=True)
    values = np.concatenate([gaussians.means_m / grid.size_m, gaussians.rgb], axis=1).astype(np.float64)
    means = np.stack([np.bincount(rows, column, len(keys)) / counts for column in values.T], axis=1)
    return keys, rows, np.column_stack([np.log(counts), means])


DEFAULT_LIMIT = 150_000


def covariances_m2(gaussians: Gaussians) -> Float32[ndarray, "n 3 3"]:
    """Return R diag(scales²) Rᵀ of each Gaussian, in square metres (Sec. III-A)."""
    quats = gaussians.quats_wxyz / np.maximum(np.linalg.norm(gaussians.quats_wxyz, axis=1, keepdims=True), 1e-12)
    w, x, y, z = quats.T
    rotations = np.stack(
        [
            *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
            *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
            *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
        ],
        axis=1,
    ).reshape(-1, 3, 3)
    scaled = rotations * gaussians.scales_m[:, None, :]
    covariances: Float32[ndarray, "n 3 3"] = scaled @ scaled.transpose(0, 2, 1)
    return covariances


def followed_contents(followed: FollowedMap, targets: dict[str, tuple[str, ...]]) -> ViewContents:
    """Return a service's map for the page. targets: the target nouns of the task of each agent of the mission.

    The `target` of a Gaussian counts within its agent's task; here it gets an index into the nouns of all tasks.
    """
    winners = followed.winners
    agents = tuple(sorted({*winners.values(), *targets}))
    nouns = tuple(dict.fromkeys(noun for agent in agents for noun in targets.get(agent, ())))
    by_voxel = [agents.index(winners[key]) if key in winners else NO_AGENT for key in followed.batch.keys.tolist()]
    agent = np.repeat(np.array(by_voxel, np.int64), followed.batch.counts)
    gaussians = followed.batch.gaussians
    target = np.full(len(gaussians), -1, np.int16)
    for index, name in enumerate(agents):
        for number, noun in enumerate(targets.get(name, ())):
            target[(agent == index) & (gaussians.target == number)] = nouns.index(noun)
    return ViewContents(replace(gaussians, target=target), agent, agents, nouns)


_BEHIND_M = 0.6
_BESIDE, _ABOVE = 0.5, 0.4
"""Distances from the map's centre along the horizontal axes and upwards, as shares of its extent."""
_MIN_EXTENT_M = 0.1
"""Of a map that is a point: the camera is never at the point that it looks at."""
_REGION_DISTANCES = 3.0
_MIN_DISTANCE_M = 0.8
"""From the task's region, in multiples of its diagonal and at least this: its surroundings are seen, too."""
_MAX_REGION_SHARE = 0.5
"""Of the map's diagonal: a larger region is the map itself."""
Vector = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class StartView:
    """Camera position, point that it looks at, and the up direction, in the world's frame."""

    position_m: Vector
    look_at_m: Vector
    up: Vector


def start_view(contents: ViewContents) -> StartView:
    """Return the start view of a map with Gaussians: of the task's region, as the camera that shows it best saw it.

    Without a region, a robot's map is seen from behind its first pose, a map without a trajectory from beside.
    """
    poses = _poses(contents)
    up = np.array(upward_axis(poses))
    low, centre, high = np.percentile(contents.gaussians.means_m.astype(np.float64), (5, 50, 95), axis=0)
    region = _region(contents)
    if region is not None and np.linalg.norm(region[1] - region[0]) < _MAX_REGION_SHARE * np.linalg.norm(high - low):
        view = _view_of_region(*region, poses, up)
        if view is not None:
            return view
    if not len(contents.times_ns):
        corners_m = [box.corners_m for box in object_boxes(contents)]
        low, high = (limit(np.concatenate([[low, high], *corners_m]), axis=0) for limit in (np.min, np.max))
        centre = 0.5 * (low + high)
        first_axis, second_axis = np.eye(3)[np.flatnonzero(up == 0)]
        offset = _BESIDE * (first_axis - second_axis) + _ABOVE * up
        extent_m = max(_MIN_EXTENT_M, float(np.linalg.norm(high - low)))
        return StartView(_vector(centre + extent_m * offset), _vector(centre), _vector(up))
    first = poses[0]
    forward = first[:3, 2]
    position = first[:3, 3] - _BEHIND_M * forward + 0.5 * _BEHIND_M * up
    distance_m = max(1.0, float(np.dot(centre - first[:3, 3], forward)))
    return StartView(_vector(position), _vector(first[:3, 3] + distance_m * forward), _vector(up))


def object_boxes(contents: ViewContents) -> list[OrientedBox]:
    """Return the box of each object."""
    up_axis = contents.up_axis
    return [OrientedBox.enclosing(landmark.corners_m, up_axis) for landmark in contents.objects]


def _poses(contents: ViewContents) -> Float64[ndarray, "n 4 4"]:
    poses = [keyframe.T_world_camera for keyframe in contents.keyframes] or list(contents.T_world_camera)
    poses += [view.T_world_camera for path in contents.paths for view in path.keyframes]
    return np.array(poses, np.float64).reshape(-1, 4, 4)


def _region(contents: ViewContents) -> tuple[Float64[ndarray, "3"], Float64[ndarray, "3"]] | None:
    """Return the ends of the box of the confirmed target with most of the region's Gaussians, or else of these."""
    means_m = contents.gaussians.means_m[contents.gaussians.active].astype(np.float64)
    pairs = zip(contents.objects, object_boxes(contents), strict=True)
    corners_m = [box.corners_m for landmark, box in pairs if landmark.role is ObjectRole.TARGET]
    limits_m = [(corners.min(axis=0), corners.max(axis=0)) for corners in corners_m]
    if limits_m:
        inside = [np.all((means_m >= low) & (means_m <= high), axis=1).sum() for low, high in limits_m]
        return limits_m[int(np.argmax(inside))]
    if not len(means_m):
        return None
    low, high = np.percentile(means_m, (10, 90), axis=0)
    return low, high


def _view_of_region(
    low: Float64[ndarray, "3"], high: Float64[ndarray, "3"], poses: Float64[ndarray, "n 4 4"], up: np.ndarray
) -> StartView | None:
    """Return a view on the line to the camera that saw the region near and in its middle; None if none saw it."""
    centre = 0.5 * (low + high)
    offsets_m = np.array([(centre - pose[:3, 3]) @ pose[:3, :3] for pose in poses]).reshape(-1, 3)
    distances_m = np.linalg.norm(offsets_m, axis=1)
    beside = np.hypot(offsets_m[:, 0], offsets_m[:, 1]) / np.maximum(offsets_m[:, 2], 1e-9)
    costs = np.where((offsets_m[:, 2] > _MIN_EXTENT_M) & (beside < 1.0), distances_m * (1 + 2 * beside), np.inf)
    if not np.isfinite(costs).any():
        return None
    best = int(np.argmin(costs))
    distance_m = max(_MIN_DISTANCE_M, _REGION_DISTANCES * float(np.linalg.norm(high - low)))
    share = min(1.0, distance_m / float(distances_m[best]))
    return StartView(_vector(centre + share * (poses[best][:3, 3] - centre)), _vector(centre), _vector(up))


def _vector(values: np.ndarray) -> Vector:
    return float(values[0]), float(values[1]), float(values[2])
