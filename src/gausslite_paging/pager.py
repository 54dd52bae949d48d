"""Keep on disk what no camera sees: tiles of space leave memory when it is short, and return when a camera nears them.

Memory holds what the new frame and the views to train on see, up to their largest depth. Views far from the camera wait
while there is no room for what they see. A part returns bit for bit as it was; what happened to the map meanwhile,
corrections by loops and changes of the task, happens to it when it is loaded. `DiskPager` is the default plug-in of the
group `gausslite.pagers`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64
from numpy import ndarray
from numpy.typing import NDArray

from gausslite.domain.camera import Camera
from gausslite.domain.errors import MapFileError
from gausslite.domain.frame import Frame
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.pose import transform_points
from gausslite.domain.state import State, add_prefix, get_array, get_counts, int_array, select_prefix
from gausslite.domain.voxels import TILE_VOXELS, VoxelBatch, VoxelGrid, VoxelIndex, select_voxels, tiles_of
from gausslite.mapping.anchors import move_with_anchors
from gausslite.mapping.keyframes import Keyframe
from gausslite.mapping.pager import MapPager
from gausslite.mapping.settings import MapperSettings
from gausslite.mapping.splat_table import NO_ANCHOR, SplatTable
from gausslite.mapping.task_change import clear_roi
from gausslite.mapping.window_view import WindowView
from gausslite.process import print_message, return_free_memory
from gausslite.render.rasterizer import GRAD_2D_COUNT, LOG_SCALE, QUAT
from gausslite_paging.keyframe_images import KeyframeImages
from gausslite_paging.page_file import Page, PageFile
from gausslite_paging.visibility import Frustum, distances_m

_RESERVED_VIEWS, _REFERENCE_PIXELS = 4, 640 * 480
"""The free rows that the seeds of the background want (`SeedingSettings.first_frame_seeds`, `mapping/seeding.py`)."""
_MAX_RESERVED = 1 / 3
_AT_ONCE = 1 / 16
"""More of the rows than needed are freed at once, so that not each frame stores something."""
_REACH_PER_SCALE = 5.0
"""A splat touches pixels up to 3.33 standard deviations from its mean; beside the image of a wide camera, up to 4.5."""
_REACH_MARGIN = 1.1
_STORES_PER_RETURN = 16
"""Each time that this many parts have left memory, what was freed goes back to the system; that takes milliseconds."""
_DEPTH_STEP_PX = 4
_PART_NUMBERS = 8
_MAX_CORRECTIONS = 32
"""So many corrections by loops may wait for the parts on disk: each takes 200 kB in an hour's map, and widens the
bounds of all parts."""


def _row_type(table: SplatTable) -> np.dtype[np.void]:
    """Return the type of a packed row with all columns of a table."""
    return np.dtype([(name, column.dtype, column.shape[1:]) for name, column in table.state().items()])


def _packed(table: SplatTable, rows: Int64[ndarray, " m"]) -> NDArray[np.void]:
    """Return all columns of these rows."""
    packed = np.empty(len(rows), _row_type(table))
    for name, column in table.state().items():
        packed[name] = column[rows]
    return packed


def _boxes_m(table: SplatTable) -> tuple[Float32[ndarray, "n 3"], Float32[ndarray, "n 3"]]:
    """Return the corners of the box of each Gaussian's pixels: a large flat one on a wall does not reach behind it."""
    quats = np.ascontiguousarray(table.rows[:, QUAT].T)
    w, x, y, z = quats / np.sqrt(np.square(quats).sum(axis=0))
    R = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    half_m = np.float32(_REACH_PER_SCALE) * np.sqrt(np.square(R * np.exp(table.rows[:, LOG_SCALE].T)).sum(axis=1)).T
    return table.means_m - half_m, table.means_m + half_m


@dataclass(frozen=True, slots=True, eq=False)
class _Part:
    """The Gaussians of a tile that left memory together."""

    tile: int  # see `tiles_of`
    count: int
    page: Page
    corrections: int  # of the map by loops, before it was stored
    tasks: int  # changes of the task before
    bounds_m: Float64[ndarray, "2 3"]  # of all pixels that they may touch
    anchors: Int64[ndarray, " a"]

    def moved(self, T_corrected_earlier: Float64[ndarray, "k 4 4"]) -> _Part:
        """Return the part with bounds around all places where its anchors take it."""
        corners = np.array(np.meshgrid(*self.bounds_m.T, indexing="ij")).reshape(3, -1).T
        places = [transform_points(T_corrected_earlier[anchor], corners) for anchor in self.anchors if anchor >= 0]
        if NO_ANCHOR in self.anchors:
            places.append(corners)
        everywhere = np.concatenate(places)
        return replace(self, bounds_m=np.stack([everywhere.min(axis=0), everywhere.max(axis=0)]))


@dataclass(frozen=True, slots=True, eq=False)
class _Tiles:
    """The rows of a table by tile, and the bounds of the pixels that those of each tile may touch."""

    index: VoxelIndex
    names: Int64[ndarray, " t"]
    bounds_m: Float64[ndarray, "t 2 3"]

    @classmethod
    def of(cls, table: SplatTable, grid: VoxelGrid) -> _Tiles:
        coarse = VoxelGrid(TILE_VOXELS * grid.size_m)
        index = VoxelIndex.from_points(table.means_m, coarse)
        names = tiles_of(grid.keys(coarse.centres_m(index.keys)))
        low_m, high_m = (bounds_m[index.rows] for bounds_m in _boxes_m(table))
        if len(names):
            low_m, high_m = np.minimum.reduceat(low_m, index.starts), np.maximum.reduceat(high_m, index.starts)
        return cls(index, names, np.stack([low_m, high_m], axis=1).astype(np.float64))

    def rows_of(self, tile: int) -> Int64[ndarray, " m"]:
        """Return the rows of the tile at this place."""
        start = self.index.starts[tile]
        return self.index.rows[start : start + self.index.counts[tile]]


def _chosen_views(
    seen: Bool[ndarray, "v t"], counts: Int64[ndarray, " t"], limit: int, near: int
) -> Bool[ndarray, " v"]:
    """Return all views if there is room for what they see, else the first one and those of the `near` next that fit.

    A few views of another place would spoil what only its other views have seen.
    """
    if counts[seen.any(axis=0)].sum() <= limit:
        return np.ones(len(seen), np.bool_)
    chosen, needed = np.zeros(len(seen), np.bool_), seen[0]
    chosen[0] = True
    for view in range(1, near + 1):
        both = needed | seen[view]
        if counts[both].sum() <= limit:
            chosen[view], needed = True, both
    return chosen


class DiskPager(MapPager):
    """Owns the parts of one map that are on disk. Not thread-safe."""

    def __init__(self, settings: MapperSettings, grid: VoxelGrid, max_bytes: int) -> None:
        """Make a temporary file. max_bytes: of it and of the images of keyframes."""
        self._settings, self._grid = settings, grid
        self._max_bytes = max_bytes
        self._file, self._images = PageFile(), KeyframeImages()
        self._parts: list[_Part] = []
        self._corrections: dict[int, Float64[ndarray, "k 4 4"]] = {}
        self._corrected = self._tasks = 0
        # of the newest frame: its eye, the tiles that memory keeps, and the views that may train; None: all
        self._eye_m = np.zeros(3)
        self._needed = np.zeros(0, np.int64)
        self._ready: frozenset[int] | None = None
        self._is_full = False
        self._unsent: set[int] = set()
        self._stores = 0

    @property
    def count(self) -> int:
        """Gaussians on disk."""
        return sum(part.count for part in self._parts)

    @property
    def stored_bytes(self) -> int:
        """Bytes on disk, with the images of keyframes."""
        return self._file.size + self._images.size

    def show(self, table: SplatTable, camera: Camera, T_world_camera: Float64[ndarray, "4 4"]) -> None:
        """Load what a camera sees, as far as seeds may be."""
        if not self._parts:
            return
        frustum = Frustum.of(camera, T_world_camera, self._reach_m(camera, np.inf))
        away_m = frustum.distances_m(*self._bounds_m().swapaxes(0, 1))
        seen = [self._parts[i] for i in np.argsort(away_m, kind="stable") if np.isfinite(away_m[i])]
        if seen:
            self._exchange(table, seen, [frustum], self._limit(table, camera.width_px * camera.height_px))

    def prepare(self, table: SplatTable, frame: Frame, window: tuple[WindowView, ...]) -> None:
        """Load what a new frame and the views to train on see, the views near the camera first."""
        self._eye_m = frame.T_world_camera[:3, 3].copy()
        limit = self._limit(table, frame.depth_m.size)
        self._needed, self._ready = np.zeros(0, np.int64), None
        if not self._parts and table.count <= limit:
            return
        tiles = _Tiles.of(table, self._grid)
        bounds_m = np.concatenate([tiles.bounds_m, self._bounds_m()])
        counts = np.concatenate([tiles.index.counts, np.array([part.count for part in self._parts], np.int64)])
        names = np.concatenate([tiles.names, self._stored_tiles()])
        views = sorted(window, key=self._distance_m)
        frusta = [self._seen_from(frame), *(self._seen_from(view.keyframe.frame) for view in views)]
        seen = np.stack([frustum.sees(bounds_m) for frustum in frusta])
        chosen = _chosen_views(seen, counts, limit, sum(self._distance_m(view) <= frusta[0].reach_m for view in views))
        frusta = [frustum for frustum, is_chosen in zip(frusta, chosen, strict=True) if is_chosen]
        needed = seen[chosen].any(axis=0)
        self._needed = np.unique(names[needed])
        self._ready = frozenset(
            view.keyframe.frame.id.number for view, is_chosen in zip(views, chosen[1:], strict=True) if is_chosen
        )
        near_m = distances_m(self._eye_m, *self._bounds_m().swapaxes(0, 1))
        wanted = needed[len(tiles.names) :]
        parts = [self._parts[i] for i in np.argsort(near_m, kind="stable") if wanted[i]]
        # views would train what they see through unfinished walls, and those that show it wait: it leaves memory
        self._exchange(table, parts, frusta, limit if chosen.all() else 0)
        if parts:
            # corrections have moved what was loaded
            tiles = _Tiles.of(table, self._grid)
            self._needed = tiles.names[np.logical_or.reduce([frustum.sees(tiles.bounds_m) for frustum in frusta])]

    def trainable(self, window: tuple[WindowView, ...]) -> tuple[WindowView, ...]:
        """Return the views whose Gaussians are in memory."""
        ready = self._ready
        return window if ready is None else tuple(view for view in window if view.keyframe.frame.id.number in ready)

    def holds(self, keys: Int64[ndarray, " v"]) -> Bool[ndarray, " v"]:
        """Return True for the voxels of the tiles with parts on disk."""
        return np.isin(tiles_of(keys), [part.tile for part in self._parts if part.tile not in self._unsent])

    def admit(self, table: SplatTable, received: VoxelBatch) -> VoxelBatch:
        """Load the tiles of these voxels; return the voxels of those that fit in memory."""
        if not self._parts:
            return received
        tiles = np.unique(tiles_of(received.keys))
        parts = [part for part in self._parts if part.tile in tiles]
        self._needed = np.union1d(self._needed, tiles)
        self._exchange(table, parts, (), table.capacity)
        return select_voxels(received, ~np.isin(tiles_of(received.keys), self._stored_tiles()))

    def keep(self, keyframe: Keyframe) -> Keyframe:
        """Return a keyframe that does not train, with its images in a file while the disk has room."""
        return self._images.keep(keyframe, self._max_bytes - self.stored_bytes)

    def stored(self, use_ema: bool, unsent_only: bool = False, seen_by: Frame | None = None) -> Iterator[Gaussians]:
        """Yield copies of the parts on disk, as they are when they return, one after the other."""
        frustum = None if seen_by is None else Frustum.of(seen_by.camera, seen_by.T_world_camera, np.inf)
        is_seen = [True] * len(self._parts) if frustum is None else frustum.sees(self._bounds_m()).tolist()
        for part, chosen in zip(tuple(self._parts), is_seen, strict=True):
            if chosen and (not unsent_only or part.tile in self._unsent):
                yield self._read(part).to_gaussians(use_ema=use_ema)

    def mark_sent(self) -> None:
        """Note that what was stored so far was published."""
        self._unsent.clear()

    def reset_roi(self) -> None:
        """Mark all that is on disk as background, when it is loaded."""
        self._tasks += 1

    def move(self, T_corrected_earlier: Float64[ndarray, "k 4 4"]) -> None:
        """Move all that is on disk with its anchors, when it is loaded."""
        if self._parts:
            self._corrections[self._corrected] = T_corrected_earlier.copy()
            self._parts = [part.moved(T_corrected_earlier) for part in self._parts]
        self._corrected += 1
        if len(self._corrections) > _MAX_CORRECTIONS:
            self._correct_oldest()

    def state(self) -> State:
        """Return the file, where its parts are, what happened since they were stored, and what the frames need."""
        parts = self._parts
        numbers = [
            (p.tile, p.count, p.corrections, p.tasks, p.page.size, p.page.crc, len(p.page.blocks), len(p.anchors))
            for p in parts
        ]
        return {
            **add_prefix("file", self._file.state()),
            "parts": np.array(numbers, np.int64).reshape(-1, _PART_NUMBERS),
            "blocks": int_array(*(block for part in parts for block in part.page.blocks)),
            "bounds_m": self._bounds_m(),
            "anchors": int_array(*(anchor for part in parts for anchor in part.anchors.tolist())),
            **{f"corrections/{i}": motions for i, motions in self._corrections.items()},
            "counts": int_array(self._corrected, self._tasks, self._is_full),
            "eye_m": self._eye_m,
            "needed": self._needed,
            "unsent": int_array(*sorted(self._unsent)),
            "ready": int_array(-1) if self._ready is None else int_array(*sorted(self._ready)),
        }

    def restore(self, state: State) -> None:
        """Continue from another pager's state. Raises MapFileError, ShapeError."""
        self._file.restore(select_prefix(state, "file"), self._max_bytes)
        numbers = get_array(state, "parts", (None, _PART_NUMBERS), np.int64)
        blocks, anchors = (iter(get_array(state, name, (None,), np.int64).tolist()) for name in ("blocks", "anchors"))
        bounds_m = get_array(state, "bounds_m", (len(numbers), 2, 3), np.float64)
        self._parts = []
        for part, (tile, count, corrections, tasks, size, crc, of_page, of_part) in enumerate(numbers.tolist()):
            page = Page(tuple(islice(blocks, of_page)), size, crc)
            own = np.array(list(islice(anchors, of_part)), np.int64)
            self._parts.append(
                _Part(tile, count, page, corrections, tasks, bounds_m=bounds_m[part].copy(), anchors=own)
            )
        self._corrections = {
            int(i): get_array(state, f"corrections/{i}", (None, 4, 4), np.float64).copy()
            for i in select_prefix(state, "corrections")
        }
        self._corrected, self._tasks, is_full = get_counts(state, "counts", 3)
        oldest = min((part.corrections for part in self._parts), default=self._corrected)
        if not self._corrections.keys() >= set(range(max(oldest, 0), self._corrected)) or oldest < 0:
            raise MapFileError("state pages corrections: expected those since each part was stored, got fewer")
        self._is_full = bool(is_full)
        self._eye_m = get_array(state, "eye_m", (3,), np.float64).copy()
        self._needed = get_array(state, "needed", (None,), np.int64).copy()
        self._unsent = set(get_array(state, "unsent", (None,), np.int64).tolist())
        ready = get_array(state, "ready", (None,), np.int64).tolist()
        self._ready = None if ready == [-1] else frozenset(ready)

    def _exchange(self, table: SplatTable, parts: Sequence[_Part], frusta: Sequence[Frustum], limit: int) -> None:
        """Load these parts, the first ones first; store tiles that nobody sees or needs until `limit` rows are left."""
        for part in parts:
            # a full disk has room for a tile when another one has been loaded: so rows above the limit are used first
            if part.count > table.free_slots:
                self._store(table, frusta, part.count - table.free_slots)
            if part.count <= table.free_slots:
                self._load(table, part)
        self._store(table, frusta, table.count - limit)

    def _load(self, table: SplatTable, part: _Part) -> None:
        loaded, first = self._read(part), table.count
        table.append_rows(loaded.rows, loaded.active, loaded.kappa, loaded.target, loaded.anchor)
        for to, column in zip(table.state().values(), loaded.state().values(), strict=True):
            to[first:] = column
        self._file.release(part.page)
        self._parts.remove(part)
        self._forget_corrections()

    def _correct_oldest(self) -> None:
        """Move the parts on disk that wait for the most corrections, if the disk has room for a copy of one."""
        oldest = min(part.corrections for part in self._parts)
        for i, part in enumerate(self._parts):
            if part.corrections > oldest:
                continue
            table = self._read(part)
            data = _packed(table, np.arange(part.count)).tobytes()
            page = self._file.write(data, self._max_bytes - self._images.size)
            if page is None:
                break
            self._file.release(part.page)
            low_m, high_m = _boxes_m(table)
            bounds_m = np.stack([low_m.min(axis=0), high_m.max(axis=0)]).astype(np.float64)
            stored = replace(part, page=page, corrections=self._corrected, tasks=self._tasks)
            self._parts[i] = replace(stored, bounds_m=bounds_m)
        self._forget_corrections()

    def _forget_corrections(self) -> None:
        oldest = min((part.corrections for part in self._parts), default=self._corrected)
        self._corrections = {i: motions for i, motions in self._corrections.items() if i >= oldest}

    def _read(self, part: _Part) -> SplatTable:
        """Return the Gaussians of a part as they are now."""
        data = self._file.read(part.page)
        table = SplatTable(part.count)
        row = _row_type(table)
        if len(data) != part.count * row.itemsize:
            raise MapFileError(f"state pages: expected {part.count} Gaussians in a part, got {len(data)} bytes")
        rows = np.frombuffer(data, row)
        table.restore({name: np.ascontiguousarray(rows[name]) for name in table.state()})
        for i in range(part.corrections, self._corrected):
            move_with_anchors(table, self._corrections[i])
        if part.tasks != self._tasks:
            clear_roi(table)
        return table

    def _store(self, table: SplatTable, frusta: Sequence[Frustum], excess: int) -> None:
        """Store tiles that nobody sees or needs until so many rows and some more are free, the farthest tiles first.

        Tiles that density control would change, as views have trained them since, come last.
        """
        if excess <= 0:
            return
        tiles = _Tiles.of(table, self._grid)
        away_m = distances_m(self._eye_m, *tiles.bounds_m.swapaxes(0, 1))
        changing = (table.first_moment[:, GRAD_2D_COUNT] > 0) | table.has_lower_opacity(
            self._settings.density.min_opacity
        )
        is_settled = ~np.logical_or.reduceat(changing[tiles.index.rows], tiles.index.starts)
        keep = np.isin(tiles.names, self._needed)
        for frustum in frusta:
            keep |= frustum.sees(tiles.bounds_m)
        stored, freed = [np.zeros(0, np.int64)], 0
        for i in np.lexsort((-away_m, ~is_settled)).tolist():
            if freed >= excess + _AT_ONCE * table.capacity:
                break
            if keep[i]:
                continue
            rows = tiles.rows_of(i)
            if not self._write(table, rows, int(tiles.names[i]), tiles.bounds_m[i]):
                break
            stored.append(rows)
            freed += len(rows)
        table.remove(np.concatenate(stored))
        self._stores += 1
        if self._stores % _STORES_PER_RETURN == 0:
            return_free_memory()

    def _write(
        self, table: SplatTable, rows: Int64[ndarray, " m"], tile: int, bounds_m: Float64[ndarray, "2 3"]
    ) -> bool:
        """Write the rows of a tile; return False if the disk has no room for them."""
        packed = _packed(table, rows)
        page = self._file.write(packed.tobytes(), self._max_bytes - self._images.size)
        if page is None:
            if not self._is_full:
                print_message("disk-mb: the disk's share is used up; from here on, max-gaussians limits the map")
            self._is_full = True
            return False
        self._unsent.add(tile)
        anchors = np.unique(packed["anchor"]).astype(np.int64)
        self._parts.append(
            _Part(tile, len(rows), page, self._corrected, self._tasks, bounds_m=bounds_m.copy(), anchors=anchors)
        )
        return True

    def _limit(self, table: SplatTable, pixels: int) -> int:
        """Return how many rows may be in use before a frame of this size is seeded."""
        seeds = _RESERVED_VIEWS * self._settings.seeding.first_frame_seeds * pixels // _REFERENCE_PIXELS
        return table.capacity - min(seeds, int(_MAX_RESERVED * table.capacity))

    def _seen_from(self, frame: Frame) -> Frustum:
        """Return what a frame sees, up to its largest depth: surfaces hide what is behind them."""
        farthest_m = float(frame.depth_m[::_DEPTH_STEP_PX, ::_DEPTH_STEP_PX].max())
        return Frustum.of(frame.camera, frame.T_world_camera, self._reach_m(frame.camera, farthest_m))

    def _reach_m(self, camera: Camera, depth_m: float) -> float:
        """Return the distance from the eye of this depth in a corner of the image, with a margin."""
        x, y = camera.unit_depth_size(camera.width_px / 2, camera.height_px / 2)
        return _REACH_MARGIN * min(depth_m, self._settings.seeding.max_depth_m) * float(np.hypot(np.hypot(x, y), 1.0))

    def _distance_m(self, view: WindowView) -> float:
        return float(np.linalg.norm(view.keyframe.frame.T_world_camera[:3, 3] - self._eye_m))

    def _stored_tiles(self) -> Int64[ndarray, " p"]:
        return np.array([part.tile for part in self._parts], np.int64)

    def _bounds_m(self) -> Float64[ndarray, "p 2 3"]:
        return np.array([part.bounds_m for part in self._parts], np.float64).reshape(-1, 2, 3)
