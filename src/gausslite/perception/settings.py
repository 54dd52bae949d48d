"""Settings of perception, in sections that follow its steps; each section is validated once.

Figures are of `gausslite bench perception` (docs/perception.md). A value without one is a bound of time or memory.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, fields
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from gausslite.domain.errors import InvalidInputError
from gausslite.domain.pose import UpAxis, unit_up_axis

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

_SHARES = ("_share", "_score", "_iou", "_fraction", "_similarity", "_margin")


def require_plausible(section: str, settings: DataclassInstance, names: Iterable[str] | None = None) -> None:
    """Raise InvalidInputError for one of these fields, or of all, that is a share outside 0 to 1 or not positive."""
    for name in names or [declared.name for declared in fields(settings)]:
        value = getattr(settings, name)
        if isinstance(value, bool) or not isinstance(value, int | float):
            continue
        if name.endswith(_SHARES):
            if not 0.0 <= value <= 1.0:
                raise InvalidInputError(f"{section} {name}: expected 0 to 1, got {value}")
        elif not value > 0:
            raise InvalidInputError(f"{section} {name}: expected a positive number, got {value}")


@dataclass(frozen=True, slots=True)
class LiftingSettings:
    """How a detected mask becomes points in the world: its depth layer, its own pixels, the planes around it."""

    min_pixels: int = 8
    """Pixels with depth that an observation needs."""
    max_pixels: int = 4000
    """Pixels that are lifted of a larger mask."""
    min_own_share: float = 0.5
    """Share of a mask that no other noun claims, from which these pixels alone locate the object."""
    depth_bin_share: float = 0.02
    """Width of a bin of depths: the noise of a depth camera at 4 m. With one layer, chairs' IoU is 0.70 (0.63)."""
    gap_bins: int = 2
    """Almost empty bins that separate two layers."""
    min_bin_share: float = 0.005
    """Share of the mask below which a bin is almost empty."""
    min_bin_to_peak: float = 0.05
    """Share of the fullest bin below which a bin is almost empty."""
    min_layer_share: float = 0.15
    """Share of the mask from which the nearest layer is the object."""
    outer_percent: float = 2.0
    """Pixels with the least and the largest depth, in percent, that do not count to the depth of a convex object."""
    depth_slack_m: float = 0.03
    """Distance from that depth within which pixels inside the outline belong to the object. Without them, the recall of
    a bowl with fruit is 0.52 instead of 0.94, and of the kitchen's table 0.80 instead of 0.88."""
    min_added_px: int = 3
    """Width from which they are more than the steps of an outline. With 5, the bowl's recall is 0.89."""
    ring_inner_px: int = 2
    """Pixels next to the outline that show no plane: their depth is often between two surfaces."""
    ring_outer_px: int = 9
    """Width of the ring around a mask in which planes are searched."""
    max_planes: int = 3
    plane_samples: int = 64
    max_ring_points: int = 600
    min_ring_points: int = 30
    min_plane_share: float = 0.2
    """Share of the ring's points that a plane has."""
    plane_distance_m: float = 0.015
    plane_distance_share: float = 0.01
    """Distance within which points are on a plane, in metres and as a share of depth; the larger one counts."""
    min_left_share: float = 0.2
    """Share of a mask that planes leave, from which they are its background; below, the object is flat itself."""
    min_plane_extent_m: float = 0.25
    """Extent from which a plane can be seen to be one."""
    max_plane_thickness_share: float = 0.06
    """Thickness of a plane relative to its extent. Seats seen from behind have 0.06 or more, or lean 7 degrees."""
    max_plane_lean_share: float = 0.1
    """Sine of the angle by which a level or upright plane leans."""

    def __post_init__(self) -> None:
        require_plausible("lifting", self)


@dataclass(frozen=True, slots=True)
class SurfaceSettings:
    """The votes on an object's surface, and the masks that follow from them."""

    voxel_sizes_m: tuple[float, ...] = (0.00625, 0.0125, 0.025)
    """Edges of the voxels, finest first; each voxel consists of eight of the next finer size."""
    extent_voxels: int = 12
    """Voxels across an object. Finer ones change no precision by more than 0.03."""
    max_voxels: int = 60_000
    max_inside_voxels: int = 15_000
    """Voxels inside a surface from which it is coarsened, if it has more than max_voxels in all."""
    part_cell_m: float = 0.05
    """Cells that touch connect the parts of a surface."""
    min_part_share: float = 0.2
    """Votes of a separate part relative to the largest. Without the cut, laptop and mugs have a precision of 0.48
    instead of 0.71."""
    vote_margin_share: float = 1.0
    """Margin around a mask whose pixels vote outside, relative to its box; a later mask that spills over is cut."""
    min_margin_px: int = 8
    max_voting_pixels: int = 40_000
    max_projected_points: int = 4000
    min_depth_m: float = 0.05
    gap_px: int = 5
    """Pixels without depth that are filled between pixels of the surface."""
    edge_radius_px: int = 2
    """Pixels by which an outline moves to a colour edge: bottles' precision 0.75 to 0.77, a mug's 0.84 to 0.88."""
    edge_epsilon: float = 1e-4
    """Variance of colour, in squared shares of the Lab range, below which an edge is noise."""
    min_inner_pixels: int = 20
    """Pixels inside the outline from which they alone give an object's colours."""
    max_colour_pixels: int = 500

    def __post_init__(self) -> None:
        require_plausible("surface", self)
        sizes_m = self.voxel_sizes_m
        if not sizes_m or sizes_m[0] <= 0 or any(coarser != 2 * finer for finer, coarser in pairwise(sizes_m)):
            raise InvalidInputError(f"surface voxel_sizes_m: expected sizes that double, got {sizes_m}")


@dataclass(frozen=True, slots=True)
class ObjectMapSettings:
    """Which observations show the same object, and how much of it is stored."""

    cell_m: float = 0.05
    """Edge of the cells that an object occupies."""
    min_match_distance_m: float = 0.15
    """Distance of centroids below which even small objects are the same."""
    match_radius_share: float = 0.75
    """Distance of centroids, relative to the smaller radius, below which objects are the same."""
    max_size_ratio: float = 2.0
    """Ratio of radii above which objects of two nouns differ: a bowl in the middle of a table is not the table."""
    min_shared_share: float = 0.3
    """Share of the smaller object's cells that the same object has."""
    min_count_share: float = 0.15
    """Observations of a cell, relative to the often observed ones, above which it belongs to the footprint."""
    min_footprint_share: float = 0.25
    """Share of the cells that a footprint has; below, all cells count."""
    max_cells: int = 4000
    max_objects: int = 500
    """Objects of a task; the least observed one is dropped first."""
    max_levels: int = 50
    """Levels of planes under an object, of which the median counts."""

    def __post_init__(self) -> None:
        require_plausible("object map", self)


@dataclass(frozen=True, slots=True)
class EvidenceSettings:
    """When a landmark is confirmed and when it is known, and which frames should show it.

    A landmark is confirmed after min_seen detections, or one of confident_score or more. Of the frames that should show
    it, at least min_seen_fraction must have detected it. Its scores must sum to at least 1 / max_rival_ratio of those
    of any different thing detected in its place: the nearest class of a detector is not always the class of the object.
    Its best score must be at least min_score_share of the best score among the objects of its target: jars are detected
    as bottles, with lower scores than the bottles.
    """

    min_seen: int = 2
    confident_score: float = 0.6
    min_seen_fraction: float = 0.25
    min_seen_known: int = 3
    """Detections after which a landmark is known. After two with high scores, chairs' precision is 0.42 (0.48)."""
    weak_share: float = 0.5
    """Weight of a weak detection among them: recall of a rarely found monitor 0.40 to 0.87."""
    min_present_fraction: float = 0.5
    """Share of its frames that found a landmark, from which it is still there if the latest one misses it. With 1, the
    recall of monitors is 0.42 instead of 0.50; with 0.33, the precision of sofas 0.90 instead of 0.91."""
    max_rival_ratio: float = 1.3
    min_score_share: float = 0.45
    depth_slack_m: float = 0.10
    depth_slack_share: float = 0.02
    """How far behind the measured depth a cell is still unoccluded, in metres and as a share of depth."""
    min_visible_share: float = 0.6
    """Share of a landmark's cells that a frame shows that should detect it."""
    max_distance_ratio: float = 1.1
    """Distance, relative to the farthest detection, up to which a frame should detect it."""

    def __post_init__(self) -> None:
        require_plausible("evidence", self)

    @classmethod
    def accept_all(cls) -> EvidenceSettings:
        """Return settings that confirm every detection."""
        return cls(min_seen=1, confident_score=0.0, min_seen_fraction=0.0, max_rival_ratio=np.inf, min_score_share=0.0)

    @classmethod
    def accept_similar(cls) -> EvidenceSettings:
        """Return settings that also confirm objects that are rather a different thing."""
        return cls(max_rival_ratio=np.inf, min_score_share=0.0)


@dataclass(frozen=True, slots=True)
class RelationSettings:
    """Distance limits of the relations. on, above, under: on_m horizontally, or over the footprint."""

    near_m: float = 0.75
    """Between surfaces. Of 724 pairs of things in homes with centroids within a metre, 705 are near."""
    between_m: float = 1.0
    on_m: float = 0.5
    side_m: float = 2.0
    """Reach of the four sides."""
    footprint_slack_m: float = 0.10
    """Horizontal distance at which an object is still over a footprint."""
    min_side_slope: float = 0.5
    """An object diagonally behind counts as behind, an object beside does not."""
    about_share: float = 0.25
    """Tolerated share of a distance that is stated as about so many metres."""
    max_sampled_cells: int = 400

    def __post_init__(self) -> None:
        require_plausible("relation", self)


@dataclass(frozen=True, slots=True)
class ColourSettings:
    """Shares of an object's pixels that decide about its colour: of 168 named colours, none was missed or wrong."""

    min_named_share: float = 0.3
    """From this share in ranges that a word names, the object is of the colour."""
    min_possible_share: float = 0.12
    """Below this share in ranges that a word could name, it is not."""

    def __post_init__(self) -> None:
        require_plausible("colour", self)


@dataclass(frozen=True, slots=True)
class HeightSettings:
    """The floor and the planes under objects, whose heights replace a detection of a surface.

    In homes 3, 4 and 6, the planes under 40 objects were measured within a centimetre.
    """

    level_bin_m: float = 0.025
    level_reach_m: float = 4.0
    """Levels below and above the first camera that are counted."""
    min_camera_height_m: float = 1.0
    max_camera_height_m: float = 2.2
    """Height of a camera carried by a person or a tall robot; other levels are rather a table than the floor."""
    min_floor_share: float = 0.02
    min_floor_points: int = 40
    points_across: int = 40
    """Points of a frame's width that are counted."""
    max_slope: float = 0.25
    """Rise between two of them, relative to their distance, up to which they are on a horizontal surface."""
    max_depth_m: float = 4.0
    bottom_percentile: float = 5.0
    plane_slack_m: float = 0.04
    """Distance from an object's bottom within which points are on the plane under it."""
    plane_reach_m: float = 0.20
    min_plane_points: int = 30
    min_plane_extent_m: float = 0.15
    max_standing_m: float = 0.06
    """Height of an object's lowest point up to which it stands on the floor."""
    lowest_percentile: float = 0.5
    """Share of a surface's voxels, in percent, below its lowest point."""

    def __post_init__(self) -> None:
        require_plausible("height", self)


@dataclass(frozen=True, slots=True)
class RelevanceTrackerSettings:
    """All sections, and when to detect: the limits of the camera's motion (a comment in Sec. III-B.2) and of frames.

    up_axis: up in the world frame, by default that of a level first camera. max_translation_m, max_rotation_deg,
    max_frames: between two detections.
    """

    up_axis: UpAxis = (0.0, -1.0, 0.0)
    max_translation_m: float = 1.0
    max_rotation_deg: float = 15.0
    max_frames: int = 5
    min_left_share: float = 0.3
    """Share of a detection outside excluded objects, below which it shows one of them."""
    min_shown_share: float = 0.5
    """Share of a known object's surface in a frame's relevance, from which the frame needs no completion."""
    lifting: LiftingSettings = field(default_factory=LiftingSettings)
    surface: SurfaceSettings = field(default_factory=SurfaceSettings)
    object_map: ObjectMapSettings = field(default_factory=ObjectMapSettings)
    evidence: EvidenceSettings = field(default_factory=EvidenceSettings)
    relations: RelationSettings = field(default_factory=RelationSettings)
    colours: ColourSettings = field(default_factory=ColourSettings)
    heights: HeightSettings = field(default_factory=HeightSettings)

    def __post_init__(self) -> None:
        require_plausible("relevance", self)
        unit_up_axis(self.up_axis)
