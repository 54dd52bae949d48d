"""Judge each frame before it is mapped: tracked, doubtful or lost; and let frames wait until their place is known.

Every start is one case: an odometry or agent that begins again, a clock that jumps, a robot that is lifted. The first
frame that contradicts makes the place doubtful, further ones make the robot lost; agreement or a found place ends both.
What a lost robot sees of a place that stays unknown is mapped apart, and joined when the place is found.
"""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from typing import TYPE_CHECKING, Final

from jaxtyping import Float64
from numpy import ndarray

from gausslite.domain.frame import Frame, FrameId
from gausslite.domain.pose import orthonormal, rotation_angle_deg, translation_m
from gausslite.domain.state import State, add_prefix, get_counts, int_array, select_prefix
from gausslite.mapping.mapper import FrameView, GaussianMapper
from gausslite.mission.localisation_monitor import Admission, LocalisationMonitor, LocalisationState
from gausslite.mission.prior_map import PriorMap
from gausslite.process import return_free_memory
from gausslite_calibration.live_check import LiveCheck
from gausslite_places.verification import verify
from gausslite_relocalisation.agreement import Agreement, compare, is_another_place
from gausslite_relocalisation.motion import Doubt, OdometrySteps
from gausslite_relocalisation.piece import Piece
from gausslite_relocalisation.place_search import PlaceSearch

if TYPE_CHECKING:
    from gausslite.wire.uplink import Uplink

_EARLIER = 3
"""The newest keyframes that a frame is compared with."""
_LOST_AFTER = 3
"""Doubtful frames in a row: a person before the camera hides a map for one or two at 2 Hz."""
_AGREEING: Final = {LocalisationState.DOUBTFUL: 1, LocalisationState.LOST: 2}
"""Frames in a row that must agree with the map at the odometry's own poses."""
_KNOWN_AFTER = 3
"""Frames that must have agreed with the map before one can contradict it: images that never fit the poses are no sign
of a lost robot."""
_SAME_POSE_M, _SAME_POSE_DEG = 0.1, 5.0
_MAX_WAITING = 16
"""Frames with images: 34 MB at 640x480."""
_CONTRADICTION: Final = "its images contradict the map"


class FrameMonitor(LocalisationMonitor):
    """Judges the frames of one mission. Not thread-safe."""

    def __init__(
        self, prior: PriorMap | None = None, in_background: bool | None = None, uplink: Uplink | None = None
    ) -> None:
        """prior: the earlier map that the mission continues. uplink: to the server that has the team's map.

        in_background: whether live frames are compared with each other there; None: they were compared before.
        """
        self._prior, self._in_background, self._uplink = prior, in_background, uplink
        self._check = None if in_background is None else LiveCheck(in_background)
        self._refusal = ""
        self._localisation = LocalisationState.TRACKED
        self._steps = OdometrySteps()
        self._waiting: deque[Frame] = deque(maxlen=_MAX_WAITING)
        self._recovered: set[FrameId] = set()
        self._search: PlaceSearch | None = None
        self._piece: Piece | None = None
        self._saved_piece: State = {}
        self._earlier: list[Frame] = []
        self._newest: Frame | None = None
        self._cause, self._is_continued = "", False
        # whether a search, and perhaps a piece, ended with the frame before
        self._has_searched = False
        # of the present doubt: its first frame; frames so far; the latest ones in a row that agree, or leave it open
        self._since = self._doubtful = self._agreed = self._open = 0
        # of the mission: frames that agreed, doubts, places that were found, pieces of map that were joined, or left
        self._known = self._doubts = self._found = self._joined = self._left = 0

    @property
    def localisation(self) -> LocalisationState:
        """The state after the latest frame."""
        return max(self._localisation, LocalisationState.DOUBTFUL) if self._refusal else self._localisation

    @property
    def notes(self) -> tuple[str, ...]:
        """One line while the robot's place is not known; one line of what happened before."""
        now, before, frames = "", "", "its frames are not mapped"
        if self._piece is not None:
            frames = f"{len(self._piece)} frames are mapped apart, and left out of the map until its place is found"
        if self._localisation is not LocalisationState.TRACKED:
            name = self._localisation.name.lower()
            now = f"the robot's place is {name} since frame {self._since}: {self._cause}; {frames}"
        elif self._doubts:
            before = f"doubts about the robot's place: {self._doubts}; places found in the map: {self._found}"
        pieces = ""
        if self._joined or self._left:
            pieces = f"pieces that were mapped apart: {self._joined} joined to the map, {self._left} left out"
        return (*(() if self._check is None else self._check.notes), *filter(None, (now, before, pieces)))

    def admit(self, frame: Frame, mapper: GaussianMapper) -> Admission:
        """Return which frames are to be mapped now; see `LocalisationMonitor.admit`."""
        if self._has_searched:
            # 100 MB for the search and a piece, in holes that the process would keep
            return_free_memory()
            self._has_searched = False
        self._newest = frame
        self._earlier = [view.keyframe.frame for view in mapper.store.window[-_EARLIER:]]
        doubt = self._steps.add(frame)
        if self._saved_piece:
            self._piece = self._open_piece(mapper)
            self._piece.restore(self._saved_piece)
            self._saved_piece = {}
        if self._piece is not None:
            return self._admit_apart(self._piece, frame, mapper)
        if doubt is not None and self._known >= _KNOWN_AFTER:
            self._begin_doubt(frame, doubt)
            self._begin_odometry()
            if self._check is not None:
                self._check.restart()
        self._refusal = "" if self._check is None else self._check.refusal(frame)
        if self._refusal:
            # no place is to be found for poses that are no poses of the camera
            self._begin_odometry()
            self._localisation = LocalisationState.TRACKED
            return Admission(reason=self._refusal)
        if self._localisation is LocalisationState.TRACKED:
            return Admission((frame,))
        return self._admit_doubtful(frame, mapper)

    def confirm(self, frame: Frame, view: FrameView) -> bool:
        """Return False if a frame contradicts the map; see `LocalisationMonitor.confirm`."""
        is_recovered = frame.id in self._recovered
        self._recovered.discard(frame.id)
        is_known = self._known >= _KNOWN_AFTER
        agreement = compare(frame, view.rendered, self._earlier, only_contradiction=is_known)
        self._known += agreement is Agreement.AGREES
        if agreement is not Agreement.CONTRADICTS or self._known < _KNOWN_AFTER:
            return True
        if not is_recovered and self._newest is not None:
            self._begin_doubt(frame, Doubt(_CONTRADICTION))
            self._steps.begin(is_followed=False)
            self._doubtful = 1
            self._waiting.append(self._newest)
        return False

    def state(self) -> State:
        """Return the state, the counts, the odometry's steps and the piece; frames that wait are not saved."""
        counts = self._known, self._doubts, self._found
        return {
            "counts": int_array(self._localisation, self._since, self._doubtful, *counts),
            "pieces": int_array(self._joined, self._left),
            **add_prefix("steps", self._steps.state()),
            **add_prefix("piece", self._saved_piece if self._piece is None else self._piece.state()),
        }

    def restore(self, state: State) -> None:
        """Continue from another monitor's state. Raises MapFileError, PoseError."""
        localisation, self._since, self._doubtful, *counts = get_counts(state, "counts", 6)
        self._known, self._doubts, self._found = counts
        # runs that were saved before pieces of map existed have none
        self._joined, self._left = get_counts(state, "pieces", 2) if "pieces" in state else (0, 0)
        self._localisation = LocalisationState(min(localisation, LocalisationState.LOST))
        self._cause = "it was so when the mission was saved"
        self._steps.restore(select_prefix(state, "steps"))
        self._saved_piece = {name: array.copy() for name, array in select_prefix(state, "piece").items()}

    def _admit_doubtful(self, frame: Frame, mapper: GaussianMapper) -> Admission:
        agreement = self._compare(frame, mapper)
        self._agreed = self._agreed + 1 if agreement is Agreement.AGREES else 0
        self._open = self._open + 1 if agreement is Agreement.UNKNOWN else 0
        self._is_continued &= agreement is not Agreement.CONTRADICTS
        # an odometry in its own frame places the robot also where nothing was mapped
        is_at_new_place = self._is_continued and self._open >= _LOST_AFTER
        if is_at_new_place or self._agreed >= _AGREEING[self._localisation]:
            return self._end_doubt(frame)
        if self._waiting and is_another_place(frame, self._waiting[-1]):
            self._begin_odometry()
        T_map_odometry = self._by_images(frame, mapper)
        if T_map_odometry is not None:
            return self._end_doubt(frame, T_map_odometry)
        self._doubtful += 1
        if self._doubtful >= _LOST_AFTER:
            self._localisation = LocalisationState.LOST
            # of an odometry that has begun again, the first frames are the nearest to the map
            offered = (*self._waiting, frame) if self._search is None else (frame,)
            self._search = self._search or PlaceSearch(mapper, self._prior, self._uplink)
            found = (self._search.offer(seen) for seen in offered)
            T_map_odometry = next((T for T in found if T is not None), None)
            if T_map_odometry is not None:
                return self._end_doubt(frame, T_map_odometry)
            if self._search.is_unknown and Piece.fits(mapper):
                return self._begin_piece(frame, mapper)
        self._waiting.append(frame)
        return Admission()

    def _begin_piece(self, frame: Frame, mapper: GaussianMapper) -> Admission:
        """Begin a piece of map with the frames that wait, and this one."""
        self._piece = piece = self._open_piece(mapper)
        for waited in (*self._waiting, frame):
            if not piece.is_lost:
                piece.add(waited)
        self._waiting.clear()
        return Admission()

    def _open_piece(self, mapper: GaussianMapper) -> Piece:
        return Piece(mapper, FrameMonitor(in_background=self._in_background))

    def _admit_apart(self, piece: Piece, frame: Frame, mapper: GaussianMapper) -> Admission:
        """Map a frame in the piece; join the piece as soon as the map shows its place."""
        self._search = self._search or PlaceSearch(mapper, self._prior, self._uplink)
        mapped = piece.add(frame)
        T_map_piece = None if mapped is None else self._search.offer(mapped)
        if T_map_piece is not None:
            joined = piece.joined(mapper, T_map_piece)
            apart = len(piece) - 1
            self._piece, self._joined, self._found = None, self._joined + 1, self._found + 1
            # this frame once more, now with the task
            return replace(self._end_doubt(frame), joined=joined, mapped_apart=apart)
        if piece.is_lost:
            self._piece, self._left = None, self._left + 1
            self._begin_odometry()
            self._steps.begin(is_followed=False)
            self._waiting.append(frame)
        return Admission()

    def _compare(self, frame: Frame, mapper: GaussianMapper) -> Agreement:
        """Compare a frame with the map at the odometry's pose."""
        T, rendered = mapper.poses.T_corrected_odometry, None
        placed = frame if T is None else replace(frame, T_world_camera=orthonormal(T @ frame.T_world_camera))
        if mapper.table.count:
            rendered = mapper.render(frame.camera, placed.T_world_camera, frame.motion)
        return compare(placed, rendered, self._earlier)

    def _by_images(self, frame: Frame, mapper: GaussianMapper) -> Float64[ndarray, "4 4"] | None:
        """Return T_map_odometry of an odometry whose jump the images have measured, if the map shows the same."""
        T_before_now = self._steps.T_before_now
        if T_before_now is None or self._is_continued or not mapper.table.count:
            return None
        T = mapper.poses.T_corrected_odometry
        T_map_now = T_before_now if T is None else T @ T_before_now
        placed = orthonormal(T_map_now @ frame.T_world_camera)
        found = verify(mapper.render, frame, placed)
        away = translation_m(placed, found.T_world_camera), rotation_angle_deg(placed, found.T_world_camera)
        # the step by the images has an error of 1 cm, the pose that fits the map best one of 4 cm
        is_shown = found.is_accepted and away[0] < _SAME_POSE_M and away[1] < _SAME_POSE_DEG
        return orthonormal(T_map_now) if is_shown else None

    def _begin_doubt(self, frame: Frame, doubt: Doubt) -> None:
        self._agreed = self._open = 0
        if self._localisation is LocalisationState.TRACKED:
            self._localisation = LocalisationState.DOUBTFUL
            self._since, self._doubtful, self._doubts = frame.index, 0, self._doubts + 1
            self._cause = doubt.cause
        self._is_continued = doubt.is_continued

    def _begin_odometry(self) -> None:
        """Forget the frames of another odometry: what places one does not place the other."""
        self._waiting.clear()
        if self._search is not None:
            self._search.restart()

    def _end_doubt(self, frame: Frame, T_map_odometry: Float64[ndarray, "4 4"] | None = None) -> Admission:
        frames = (*self._waiting, frame)
        self._recovered = {waited.id for waited in frames}
        self._waiting.clear()
        self._has_searched, self._search = self._search is not None, None
        self._steps.begin(is_followed=True)
        self._found += T_map_odometry is not None
        self._localisation = LocalisationState.TRACKED
        return Admission(frames, T_map_odometry)
