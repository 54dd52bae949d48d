"""Close loops: register a keyframe with one of long ago that saw the same place, and correct all poses by the graph.

Candidates are the nearest earlier keyframe by position, and the most similar one by its place descriptor. Their depth
surfaces give the motion to a centimetre, and their images refine it. A motion that would move the map is verified: what
earlier keyframes have mapped, rendered from the new pose, must not draw the pose back, and it or the earlier image must
agree with the new image. The pose graph then decides which loops are true. One that it rejects, at once or later, is
counted and reported, and does not correct the map.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.domain.camera import Camera, CameraMotion
from gausslite.domain.frame import Frame
from gausslite.domain.pose import inverse, orthonormal, rotation_angle_deg, translation_m
from gausslite.domain.recording import PoseExposurePrior
from gausslite.domain.state import State, add_prefix, get_array, get_counts, int_array, select_prefix
from gausslite.mapping.keyframes import Keyframe
from gausslite.mapping.pose_corrector import LoopCounts, PoseCorrector
from gausslite.mapping.splat_table import NO_ANCHOR, SplatTable
from gausslite.process import print_message
from gausslite.render.rasterizer import Rasterizer, Rendering, Subset
from gausslite_calibration.moving_pairs import warp_into
from gausslite_places.descriptors import DESCRIPTOR_BYTES, PlaceDescriptor
from gausslite_places.localisation import View, guessed_motions
from gausslite_places.pose_graph import Loop, PoseGraph, require_graph_solver
from gausslite_places.surface_registration import register
from gausslite_places.verification import RenderMap, reduced, verify
from gausslite_poses.photometric import align_images

MIN_GAP = 8
"""Keyframes between two passes; what lies closer together in time is aligned by the refinement of views."""
_MAX_DISTANCE = 1.5
"""Of a candidate by position: metres plus radians."""
_MIN_SIMILARITY = 0.6
"""Of the descriptors of a candidate by appearance."""
_ALIGNED_STD = np.array([0.03] * 3 + [np.radians(0.7)] * 3)
"""Error of a registered motion before images refine it: translation (m) and rotation (rad)."""
_MIN_ALIGNED = 0.5
"""Share of the points in both images whose depth must agree."""
_MAX_SHARE, _MOVED_M, _MOVED_DEG = 0.5, (0.03, 0.08), (1.0, 2.0)
"""The rendering may move the pose of a loop by this share of the correction, within these limits. Where depth or images
of a camera err, surfaces and images agree on a wrong motion, and the map draws the pose back: by 0.8 to 1.05 of the
correction in the kitchen of 7-Scenes, by 3.6 cm and more. True loops of homes with drift are moved by a seventh of
19 cm, by two fifths of 4 cm, and by up to 2.6 cm and 0.7 degrees (1.4 pixels of a small image) of smaller ones."""
_NOISE = 0.006, 0.15
"""A loop that the poses contradict by less, in metres and degrees, moves nothing until another one does."""
_NOISE_STDS = 2.0 * 2.0**0.5
"""So does a loop within this many standard deviations of a pose's error: it is noise of single poses and no drift."""


class LoopCloser(PoseCorrector):
    """Finds loops of one map and owns the pose graph of its keyframes. Not thread-safe."""

    def __init__(self, rasterizer: Rasterizer, prior: PoseExposurePrior) -> None:
        """Prior: of the error of single poses. Raises MissingPluginError if GTSAM is not installed."""
        require_graph_solver()
        self._rasterizer = rasterizer
        self._prior, self._graph = prior, PoseGraph(prior)
        self._noise = (
            max(_NOISE[0], _NOISE_STDS * prior.translation_m),
            max(_NOISE[1], _NOISE_STDS * prior.rotation_deg),
        )
        self._descriptors: list[PlaceDescriptor] = []
        self._times_ns: list[int] = []
        self._refused = self._withdrawn = self._corrections = 0

    @property
    def counts(self) -> LoopCounts:
        """What became of the loops so far."""
        accepted = int(np.count_nonzero(self._graph.accepted))
        rejected = len(self._graph.accepted) - accepted
        return LoopCounts(self._refused, accepted, rejected, self._withdrawn, self._corrections)

    @property
    def keyframes(self) -> int:
        """The number of keyframes so far."""
        return len(self._graph)

    def add(
        self, keyframe: Keyframe, prior: Frame, kept: Sequence[Keyframe], table: SplatTable
    ) -> Float64[ndarray, "k 4 4"] | None:
        """Add the next keyframe; return the motion of each keyframe in world axes if a loop corrects them, else None.

        See `PoseCorrector.add`.
        """
        last = None
        for old in kept:
            if old.frame.capture_time_ns == self._times_ns[old.anchor]:
                self._graph.set_pose(old.anchor, old.frame.T_world_camera)
                last = old if old.anchor == keyframe.anchor - 1 else last
        T_last_keyframe = None if last is None else _aligned(last, keyframe, _relative(last, keyframe))
        self._graph.add(prior.T_world_camera, keyframe.frame.T_world_camera, T_last_keyframe)
        self._times_ns.append(keyframe.frame.capture_time_ns)
        view = View.of(keyframe.frame)
        self._descriptors.append(view.descriptor)
        loop = self._find(keyframe, view, [old for old in kept if old.anchor <= keyframe.anchor - MIN_GAP], table)
        # until a loop has shown a drift, images may err more than the odometry from one keyframe to the next
        step = self._graph.newest_step if self._corrections else None
        is_noise = (loop is None or self._is_noise(loop)) and (step is None or self._is_noise(step, _NOISE))
        if loop is not None:
            self._graph.add_loop(loop)
        return None if is_noise else self._solve(loop)

    def begin_another(self) -> LoopCloser:
        """Return one without keyframes; see `PoseCorrector.begin_another`."""
        return LoopCloser(self._rasterizer, self._prior)

    def joined(self, piece: State, T_map_piece: Float64[ndarray, "4 4"]) -> State:
        """Return the state with the keyframes of a piece; see `PoseCorrector.joined`."""
        state = self.state()
        return {
            "counts": state["counts"] + piece["counts"],
            **{name: np.concatenate([state[name], piece[name]]) for name in ("descriptors", "times_ns")},
            **add_prefix("graph", self._graph.joined(select_prefix(piece, "graph"), T_map_piece)),
        }

    def state(self) -> State:
        """Return the pose graph and the counts."""
        counts = int_array(self._refused, self._withdrawn, self._corrections)
        descriptors = np.array([descriptor.values for descriptor in self._descriptors], np.uint8)
        return {
            "counts": counts,
            "descriptors": descriptors.reshape(-1, DESCRIPTOR_BYTES),
            "times_ns": np.array(self._times_ns, np.int64),
            **add_prefix("graph", self._graph.state()),
        }

    def restore(self, state: State) -> None:
        """Continue from another state. Raises MapFileError, PoseError."""
        self._refused, self._withdrawn, self._corrections = get_counts(state, "counts", 3)
        self._graph.restore(select_prefix(state, "graph"))
        descriptors = get_array(state, "descriptors", (len(self._graph), DESCRIPTOR_BYTES), np.uint8)
        self._descriptors = [PlaceDescriptor(values.copy()) for values in descriptors]
        self._times_ns = get_array(state, "times_ns", (len(self._graph),), np.int64).tolist()

    def _solve(self, newest: Loop | None) -> Float64[ndarray, "k 4 4"]:
        """Solve the pose graph and report the loops that it rejects."""
        solution = self._graph.solve()
        for i in np.flatnonzero(self._graph.accepted & ~solution.accepted).tolist():
            loop = self._graph.loops[i]
            print_message(
                f"loop between keyframes {loop.earlier} and {loop.later} rejected: it contradicts the others; "
                "it does not correct the map"
            )
            self._withdrawn += loop is not newest
        self._corrections += 1
        return self._graph.apply(solution)

    def _find(self, keyframe: Keyframe, view: View, earlier: Sequence[Keyframe], table: SplatTable) -> Loop | None:
        """Return the loop of a keyframe with one of these; None if it saw the place of none, or images disagree."""
        if not earlier:
            return None
        frame, earlier_map = keyframe.frame, self._earlier_map(keyframe, table)
        nearest = min(earlier, key=lambda old: _distance(old.frame, frame))
        if _distance(nearest.frame, frame) < _MAX_DISTANCE:
            loop = self._registered(keyframe, view, nearest, _relative(nearest, keyframe), earlier_map)
            if loop is not None:
                return loop
        similar = max(earlier, key=self._similarity)
        if similar is nearest or self._similarity(similar) < _MIN_SIMILARITY:
            return None
        for guess in guessed_motions(view, View.of(similar.frame)):
            loop = self._registered(keyframe, view, similar, guess, earlier_map)
            if loop is not None:
                return loop
        return None

    def _similarity(self, old: Keyframe) -> float:
        """Return the similarity of an earlier keyframe to the newest one."""
        return self._descriptors[old.anchor].similarity(self._descriptors[-1])

    def _registered(
        self, keyframe: Keyframe, view: View, old: Keyframe, guess: Float64[ndarray, "4 4"], earlier_map: RenderMap
    ) -> Loop | None:
        """Return the loop of two keyframes if their surfaces fit and, if it moves the map, the rendering agrees."""
        registration = register(view.surface, View.of(old.frame).surface, guess)
        T_old_keyframe = None if registration is None else _aligned(old, keyframe, registration.T_target_source)
        if T_old_keyframe is None:
            return None
        T_world_camera = old.frame.T_world_camera @ T_old_keyframe
        loop = Loop(old.anchor, keyframe.anchor, inverse(self._graph.poses[old.anchor]) @ T_world_camera)
        if self._is_noise(loop) or self._is_verified(keyframe, old, loop, T_world_camera, earlier_map):
            return loop
        self._refused += 1
        return None

    def _is_verified(
        self,
        keyframe: Keyframe,
        old: Keyframe,
        loop: Loop,
        T_world_camera: Float64[ndarray, "4 4"],
        earlier_map: RenderMap,
    ) -> bool:
        """True if the map does not draw a loop's pose back, and it or the earlier image shows the same from there."""
        frame, error_m, error_deg = keyframe.frame, *self._graph.residual(loop)
        shown = verify(earlier_map, frame, T_world_camera)
        moved_m = translation_m(shown.T_world_camera, T_world_camera)
        moved_deg = rotation_angle_deg(shown.T_world_camera, T_world_camera)
        max_m, max_deg = np.clip(_MAX_SHARE * error_m, *_MOVED_M), np.clip(_MAX_SHARE * error_deg, *_MOVED_DEG)
        if not shown.depth_agrees or moved_m >= max_m or moved_deg >= max_deg:
            return False
        return shown.is_accepted or verify(_render_image(old.frame), frame, T_world_camera).is_accepted

    def _earlier_map(self, keyframe: Keyframe, table: SplatTable) -> RenderMap:
        """Return a function that renders what earlier keyframes have mapped."""
        earlier = (table.anchor <= keyframe.anchor - MIN_GAP) & (table.anchor != NO_ANCHOR)
        subset = Subset(None, np.flatnonzero(earlier).astype(np.uint32))

        def render(camera: Camera, T_world_camera: Float64[ndarray, "4 4"], motion: CameraMotion | None) -> Rendering:
            return self._rasterizer.forward(table.rows, camera, inverse(T_world_camera), subset, motion)

        return render

    def _is_noise(self, motion: Loop, limits: tuple[float, float] | None = None) -> bool:
        """True if the poses agree with a motion to these limits (m, degrees), so that it does not move the map."""
        error_m, error_deg = self._graph.residual(motion)
        limit_m, limit_deg = limits or self._noise
        return error_m < limit_m and error_deg < limit_deg


def _relative(old: Keyframe, keyframe: Keyframe) -> Float64[ndarray, "4 4"]:
    """Return T_old_keyframe by the poses in the map."""
    T_old_keyframe: Float64[ndarray, "4 4"] = inverse(old.frame.T_world_camera) @ keyframe.frame.T_world_camera
    return T_old_keyframe


def _render_image(old: Frame) -> RenderMap:
    """Return a function that shows an earlier image from another pose, by its depth."""
    old = reduced(old)

    def render(camera: Camera, T_world_camera: Float64[ndarray, "4 4"], _: CameraMotion | None) -> Rendering:
        height, width = camera.height_px, camera.width_px
        rgb, depth_m = np.zeros((height, width, 3), np.uint8), np.zeros((height, width), np.float32)
        return warp_into(old, Frame(0, 0, rgb, depth_m, camera, T_world_camera))

    return render


def _aligned(
    old: Keyframe, keyframe: Keyframe, T_old_keyframe: Float64[ndarray, "4 4"]
) -> Float64[ndarray, "4 4"] | None:
    """Return the motion refined by both images; None if they show too little in common there."""
    aligned = align_images(old.frame, keyframe.frame, T_old_keyframe, _ALIGNED_STD)
    if aligned is None or aligned.overlap < _MIN_ALIGNED:
        return None
    return orthonormal(aligned.T_world_camera)


def _distance(a: Frame, b: Frame) -> float:
    """Return the distance of two views: metres plus radians."""
    turned_deg = rotation_angle_deg(a.T_world_camera, b.T_world_camera)
    return translation_m(a.T_world_camera, b.T_world_camera) + float(np.radians(turned_deg))
