"""What a corrector returns moves the map, its keyframes and the poses; loops need its package only if they are on."""

from collections.abc import Sequence

import numpy as np
import pytest
from mapping_scenes import map_frame, wall_frame

from gausslite import plugins
from gausslite.domain.errors import MissingPluginError
from gausslite.domain.frame import Frame
from gausslite.domain.pose import transform_of
from gausslite.domain.recording import PoseExposurePrior
from gausslite.domain.state import State
from gausslite.mapping.keyframes import Keyframe
from gausslite.mapping.mapper import GaussianMapper
from gausslite.mapping.pose_corrector import LoopCounts, PoseCorrector
from gausslite.mapping.settings import KeyframeSettings, MapperSettings
from gausslite.mapping.splat_table import SplatTable
from gausslite.mission import build
from gausslite.mission.settings import LoopMode, MissionSettings
from gausslite.render.cpu import CpuRasterizer

MOTION = transform_of(np.array([0.1, 0.0, 0.05, 0.0, 0.0, 0.1]))
POSES_MAY_ERR = PoseExposurePrior(0.006, 0.15)


class _SecondMoves:
    """Moves both keyframes when the second one comes."""

    def __init__(self) -> None:
        self.keyframes = 0

    @property
    def counts(self) -> LoopCounts:
        return LoopCounts(corrections=int(self.keyframes > 1))

    def add(self, keyframe: Keyframe, prior: Frame, kept: Sequence[Keyframe], table: SplatTable) -> np.ndarray | None:
        assert keyframe.anchor == self.keyframes
        assert table.count > 0
        self.keyframes += 1
        return np.array([MOTION] * self.keyframes) if self.keyframes == 2 else None

    def state(self) -> State:
        return {"keyframes": np.array([self.keyframes])}

    def restore(self, state: State) -> None:
        [self.keyframes] = state["keyframes"].tolist()


def _mapped(corrector: PoseCorrector | None, frames: int) -> GaussianMapper:
    settings = MapperSettings(max_gaussians=500, keyframes=KeyframeSettings(every=1))
    mapper = GaussianMapper(settings, CpuRasterizer(threads=1), corrector=corrector)
    for index in range(frames):
        frame = wall_frame(index, shift_m=0.02 * index)
        map_frame(mapper, frame)
    return mapper


def test_a_correction_moves_keyframes_and_the_odometry_to_come() -> None:
    mapper, plain = _mapped(_SecondMoves(), 2), _mapped(None, 2)
    assert mapper.corrector is not None
    assert mapper.corrector.counts.corrections == 1
    for moved, own in zip(mapper.store.kept, plain.store.kept, strict=True):
        np.testing.assert_allclose(moved.frame.T_world_camera, MOTION @ own.frame.T_world_camera, atol=1e-9)
    frame = wall_frame(2)
    np.testing.assert_allclose(
        mapper.poses.add_odometry(frame).T_world_camera, MOTION @ frame.T_world_camera, atol=1e-9
    )
    assert plain.poses.add_odometry(frame) is frame


def test_a_corrector_is_part_of_a_saved_mapper() -> None:
    saved, other = _mapped(_SecondMoves(), 1), _mapped(_SecondMoves(), 0)
    other.restore(saved.state())
    assert other.state()["loops/keyframes"] == [1]


def test_loops_need_their_package_only_if_they_are_on(monkeypatch: pytest.MonkeyPatch) -> None:
    def no_package(_group: plugins.Group, name: str = plugins.DEFAULT, purpose: str = "") -> None:
        raise MissingPluginError(f"{purpose}: needs the package places, which is not installed")

    monkeypatch.setattr(build, "load", no_package)
    rasterizer = CpuRasterizer(threads=1)
    assert build.open_corrector(MissionSettings(pose_prior=POSES_MAY_ERR), rasterizer) is None
    assert build.open_corrector(MissionSettings(loops=LoopMode.ON), rasterizer) is None, "exact poses"
    with pytest.raises(MissingPluginError, match="loops: needs the package places"):
        build.open_corrector(MissionSettings(loops=LoopMode.ON, pose_prior=POSES_MAY_ERR), rasterizer)
