"""A saved run continues with bit-identical results in another process; other files and settings are refused."""

import json
import sys
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from mapping_scenes import wall_frame
from other_process import run_python

from gausslite.codec.state_file import read_state, write_state
from gausslite.domain.errors import GaussLiteError, MapFileError, MismatchError
from gausslite.domain.frame import Frame
from gausslite.domain.recording import PoseExposurePrior
from gausslite.domain.relevance import BallRegion
from gausslite.domain.state import State, generator_state, restore_generator, select_prefix
from gausslite.domain.task import Predicate, Relation, TaskGraph
from gausslite.domain.voxels import VoxelBatch, VoxelGrid
from gausslite.mapping.mapper import GaussianMapper
from gausslite.mapping.settings import DensitySettings, KeyframeSettings, MapperSettings, SeedingSettings
from gausslite.mapping.voxel_exchange import SentVoxelTracker
from gausslite.mission.checkpoint import ResumeConfig, SavedRun, save_run
from gausslite.mission.settings import MissionSettings, TaskSettings
from gausslite.mission.task_mapper import TaskMapper
from gausslite.perception.detector import RegionDetector
from gausslite.perception.relevance import TaskRelevanceEstimator
from gausslite.perception.settings import RelevanceTrackerSettings
from gausslite.render.cpu import CpuRasterizer

GRAPH = TaskGraph(
    task_id="t",
    text="Pick up the mug on the table",
    targets=("mug",),
    anchors=("table",),
    relations=(Relation(Predicate.ON, "mug", "table"),),
    warnings=(),
)
REGIONS = {"mug": BallRegion((0.1, -0.1, 2.0), 0.3), "table": BallRegion((0.0, 0.3, 2.0), 0.5)}
FRAMES, CUT = 11, 5
SETTINGS = (MissionSettings(), TaskSettings(task=GRAPH.text))
CONFIG = ResumeConfig.of(*SETTINGS)


def make_task_mapper(max_gaussians: int = 400, window: int = 2) -> TaskMapper:
    """A mapper with refined poses, frequent density control, and a window smaller than the buffer, which is thinned."""
    mapper_settings = MapperSettings(
        max_gaussians=max_gaussians,
        seeding=SeedingSettings(first_frame_seeds=60_000, later_seeds=20_000),
        keyframes=KeyframeSettings(every=2, window=window, buffer=3, long_term_keyframes=2),
        density=DensitySettings(densify_every=7, prune_every=5),
        pose_prior=PoseExposurePrior(0.01, 0.5, 0.1, 0.05),
    )
    estimator = TaskRelevanceEstimator(GRAPH, RegionDetector(REGIONS), RelevanceTrackerSettings(max_frames=3))
    mapper = GaussianMapper(mapper_settings, CpuRasterizer(threads=1), seed=3)
    return TaskMapper(estimator, mapper, SentVoxelTracker(VoxelGrid()))


def frames(first: int, end: int) -> Iterator[Frame]:
    return (wall_frame(i, (48, 32), shift_m=0.03 * i) for i in range(first, end))


def changes_of_run(run: TaskMapper, first: int, end: int) -> list[VoxelBatch | None]:
    return [run.process(frame).changed_roi for frame in frames(first, end)]


def assert_same(actual: State, expected: State) -> None:
    assert set(actual) == set(expected)
    for name in expected:
        assert actual[name].dtype == expected[name].dtype, name
        assert actual[name].shape == expected[name].shape, name
        assert actual[name].tobytes() == expected[name].tobytes(), name


def checksums(run: TaskMapper, changes: list[VoxelBatch | None]) -> dict[str, int]:
    """Return a checksum of each array of the state and of each frame's changes, to compare two processes."""
    sums = {name: zlib.crc32(array.tobytes()) for name, array in run.state().items()}
    for i, batch in enumerate(changes):
        assert batch is not None
        sums[f"changes {i}"] = zlib.crc32(_bytes_of(batch))
    return sums


def _bytes_of(batch: VoxelBatch) -> bytes:
    return batch.keys.tobytes() + batch.gaussians.means_m.tobytes() + batch.counts.tobytes()


def resume(path: str) -> None:
    """Resume the run in another process, map the remaining frames and print the checksums."""
    run, saved = make_task_mapper(), SavedRun.read(Path(path))
    saved.restore(run)
    print(json.dumps(checksums(run, changes_of_run(run, saved.last_index + 1, FRAMES))))


def test_a_stopped_and_resumed_run_is_bit_identical_to_an_uninterrupted_one(tmp_path: Path) -> None:
    uninterrupted = make_task_mapper()
    changes = changes_of_run(uninterrupted, 0, FRAMES)
    first = make_task_mapper()
    changes_of_run(first, 0, CUT)
    save_run(tmp_path / "run.state", first, CONFIG, CUT - 1)
    code = f"import sys; sys.path[:0] = {sys.path!r}; import test_checkpoint; test_checkpoint.resume(sys.argv[1])"
    done = run_python("-c", code, tmp_path / "run.state")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == checksums(uninterrupted, changes[CUT:])
    assert uninterrupted.state()["mapper/table/kappa"].max() > 0
    assert len(uninterrupted.state()["mapper/keyframes/buffer"]) == 3


def test_settings_survive_the_file(saved: Path) -> None:
    run = SavedRun.read(saved)
    assert run.value(MissionSettings, "pose_prior") == SETTINGS[0].pose_prior
    assert run.value(MissionSettings, "disabled") == SETTINGS[0].disabled
    assert run.value(MissionSettings, "poses") is SETTINGS[0].poses
    pytest.raises(MapFileError, run.value, MissionSettings, "threads").match(r"MissionSettings\.threads")


def test_saving_changes_nothing_and_restoring_gives_the_saved_state(tmp_path: Path) -> None:
    run, same = make_task_mapper(), make_task_mapper()
    changes_of_run(run, 0, CUT)
    before = {name: array.copy() for name, array in run.state().items()}
    save_run(tmp_path / "run.state", run, CONFIG, CUT - 1)
    assert_same(run.state(), before)
    saved = SavedRun.read(tmp_path / "run.state")
    saved.restore(same)
    assert (saved.last_index, saved.config) == (CUT - 1, CONFIG)
    assert_same(same.state(), before)


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    run, path = make_task_mapper(), tmp_path_factory.mktemp("saved") / "run.state"
    changes_of_run(run, 0, 3)
    save_run(path, run, CONFIG, 2)
    return path


def test_all_options_that_differ_are_named(saved: Path) -> None:
    run = SavedRun.read(saved)
    run.require(*SETTINGS)
    # threads and backend may change
    run.require(MissionSettings(threads=1, backend="cpu"), SETTINGS[1])
    other = MissionSettings(policy="uniform", rate_hz=4.0, max_gaussians=9), TaskSettings("Find the chair")
    with pytest.raises(MismatchError) as caught:
        run.require(*other)
    assert str(caught.value) == (
        f"{saved}: expected the options of the saved run, max-gaussians '150000' (got '9'), policy 'task' (got "
        "'uniform'), rate unset (got '4'), task 'Pick up the mug on the table' (got 'Find the chair')"
    )
    # an option that only one of them has counts as a difference, unless its value is false; resegment is no option now
    assert ResumeConfig({"Other": {"target_at": [], "resegment": False, "spool": None}}).differences() == ()
    assert ResumeConfig({"Other": {"size": "1x2"}}).differences() == ("size '1x2' (got unset)",)


def test_a_mapper_that_is_too_small_is_refused(saved: Path) -> None:
    with pytest.raises(MapFileError, match="max_gaussians: expected at least"):
        SavedRun.read(saved).restore(make_task_mapper(max_gaussians=10))
    with pytest.raises(MapFileError, match="expected at most 1, got 2"):
        SavedRun.read(saved).restore(make_task_mapper(window=1))


def test_a_config_that_is_not_json_objects_is_refused(saved: Path, tmp_path: Path) -> None:
    state, damaged = read_state(saved), tmp_path / "run.state"
    for config in ("", "[1]", '{"a": 1}', "[" * 100_000, "\0"):
        write_state(damaged, {**state, "run/config": np.frombuffer(config.encode(), np.uint8)})
        pytest.raises(MapFileError, SavedRun.read, damaged).match(r"run\.state: state config: expected settings")


@pytest.fixture(scope="module")
def state(tmp_path_factory: pytest.TempPathFactory) -> State:
    run, path = make_task_mapper(), tmp_path_factory.mktemp("states") / "run.state"
    changes_of_run(run, 0, 2)
    save_run(path, run, CONFIG, 1)
    return read_state(path)


def forgeries(array: np.ndarray) -> Iterator[np.ndarray]:
    """Yield arrays of another length, another type, and with all bytes equal."""
    yield np.concatenate([array.ravel(), array.ravel(), np.zeros(1, array.dtype)])
    yield array.astype(np.float64 if array.dtype != np.float64 else np.float32)
    for byte in (0, 1) if array.dtype == np.bool_ else (0, 127, 255):
        same = array.copy()
        same.reshape(-1).view(np.uint8)[:] = byte
        yield same


@pytest.mark.slow
def test_a_forged_array_is_rejected_or_mapping_continues(state: State) -> None:
    saved = select_prefix(state, "mapper")
    rejected = 0
    for name, array in saved.items():
        for forged_array in (None, *forgeries(array)):
            fresh = make_task_mapper()
            others = {other: each for other, each in saved.items() if other != name}
            try:
                fresh.restore(others if forged_array is None else {**others, name: forged_array})
            except GaussLiteError:
                rejected += 1
                continue
            changes_of_run(fresh, 2, 3)
    assert rejected > 3 * len(saved)


def test_a_restored_generator_continues_the_sequence_of_the_saved_one() -> None:
    a, b = np.random.default_rng(5), np.random.default_rng(6)
    a.integers(0, 2**32, 3, np.uint32)  # leaves a buffered half of a 64-bit draw
    restore_generator(b, generator_state(a))
    np.testing.assert_array_equal(a.integers(0, 2**32, 9, np.uint32), b.integers(0, 2**32, 9, np.uint32))
    np.testing.assert_array_equal(a.standard_normal(9), b.standard_normal(9))


def test_all_types_and_shapes_are_read_back(tmp_path: Path) -> None:
    arrays = {
        f"{dtype}-{shape}": np.arange(int(np.prod(shape)), dtype=np.int64).reshape(shape).astype(dtype)
        for dtype in ("?", "u1", "i2", "u4", "i8", "u8", "f4", "f8")
        for shape in ((), (0,), (3,), (2, 0, 5), (2, 3, 4))
    }
    write_state(tmp_path / "all.state", arrays)
    assert_same(read_state(tmp_path / "all.state"), arrays)
