"""Scores of `bench perception` on a scene and detectors with known results."""

import json
from collections.abc import Sequence

import numpy as np
import pytest
from tiny_sequences import write_seven_scenes
from tiny_yolo import write_tiny_yolo

from gausslite.cli.main import main
from gausslite.domain.camera import Camera
from gausslite.domain.errors import InvalidInputError
from gausslite.domain.frame import Frame
from gausslite.domain.objects import NounMatch
from gausslite.domain.relevance import BallRegion, Detection
from gausslite.domain.task import TaskGraph
from gausslite.perception.detector import RegionDetector
from gausslite_bench.perception.stage_scores import PerceptionBench, PerceptionStage, TaskQuery

CAMERA = Camera(100.0, 100.0, 80.0, 60.0, 160, 120)
UP = (0.0, -1.0, 0.0)
REGIONS = {"mug_1": BallRegion((-0.3, 0.0, 2.0), 0.15), "mug_2": BallRegion((0.3, 0.0, 2.0), 0.15)}
MUGS = TaskQuery(TaskGraph("id", "Find the mug", ("mug",), (), ()), ("mug_1", "mug_2"))
ABSENT = TaskQuery(TaskGraph("id", "Find the vase", ("vase",), (), ()), ())


def frames(count: int) -> list[Frame]:
    depth_m, rgb = np.full((120, 160), 2.0, np.float32), np.full((120, 160, 3), 99, np.uint8)
    return [Frame(index, index * 10**9, rgb, depth_m, CAMERA, np.eye(4)) for index in range(count)]


class WeakDetector:
    """Detects one of two mugs with a low score, and a false vase in the first frame."""

    def matches(self, queries: Sequence[str]) -> tuple[NounMatch, ...]:
        return ()

    def detect(self, frame: Frame, queries: Sequence[str]) -> list[Detection]:
        mug = REGIONS["mug_1"].mask(frame)
        vase = np.zeros_like(mug)
        vase[:30, :40] = frame.index == 0
        found = {"mug": mug, "vase": vase}
        return [
            Detection(query, 0.4, (0.0, 0.0, 160.0, 120.0), found[query]) for query in queries if found[query].any()
        ]


def test_an_exact_detector_is_right_in_every_stage():
    bench = PerceptionBench(RegionDetector(REGIONS), [MUGS], REGIONS, UP)
    for frame in frames(7):
        bench.process(frame)
    (score,) = bench.scores()
    assert (score.frames, score.shown_frames, score.shown_objects) == (7, 7, 2)
    for stage, stage_score in score.stages.items():
        # between detections, the outline has the resolution of the surface's voxels
        exact = 0.9 if stage in (PerceptionStage.TRACKED, PerceptionStage.COMPLETED) else 1.0
        assert stage_score.iou >= exact
        assert (
            stage_score.marked_frames,
            stage_score.right_frames,
            stage_score.objects_found,
            stage_score.late_frames,
        ) == (7, 7, 2, 0)


def test_scores_of_a_weak_detector():
    bench = PerceptionBench(WeakDetector(), [MUGS, ABSENT], REGIONS, UP)
    for frame in frames(4):
        bench.process(frame)
    mugs, vase = bench.scores()
    detected, confirmed = mugs.stages[PerceptionStage.DETECTED], mugs.stages[PerceptionStage.CONFIRMED]
    assert (detected.precision, detected.recall, detected.late_frames) == (1.0, 0.5, 0.0)
    assert (confirmed.precision, confirmed.recall, confirmed.late_frames) == (1.0, 0.375, 1.0)
    assert mugs.stages[PerceptionStage.TRACKED].objects_found == 1
    assert vase.stages[PerceptionStage.DETECTED].marked_max == 30 * 40 / (120 * 160)
    assert vase.stages[PerceptionStage.DETECTED].marked_mean == 30 * 40 / (120 * 160) / 4
    assert (
        vase.stages[PerceptionStage.TRACKED].marked_frames == vase.stages[PerceptionStage.CONFIRMED].marked_frames == 0
    )
    assert vase.stages[PerceptionStage.DETECTED].iou is None


def test_the_frame_before_an_object_was_confirmed_is_completed():
    bench = PerceptionBench(WeakDetector(), [MUGS], REGIONS, UP)
    for frame in frames(8):
        bench.process(frame)
    (mugs,) = bench.scores()
    tracked, completed = mugs.stages[PerceptionStage.TRACKED], mugs.stages[PerceptionStage.COMPLETED]
    assert (tracked.late_frames, tracked.marked_frames) == (1.0, 7)
    assert (completed.late_frames, completed.marked_frames) == (0.0, 8)
    assert tracked.recall < 0.45 < completed.recall <= 0.5


def test_objects_must_be_known():
    with pytest.raises(InvalidInputError, match="expected names among mug_1, mug_2; got mug_3"):
        PerceptionBench(RegionDetector(REGIONS), [TaskQuery(MUGS.graph, ("mug_3",))], REGIONS, UP)


@pytest.fixture
def arguments(tmp_path) -> list[str]:
    """Command line for frames of a wall at 2 m with a mug, and a detector of cups and dogs."""
    np.savez(
        tmp_path / "roi.npz",
        mug=np.array([[x, y, 100] for x in range(-50, 50) for y in range(-50, 50)]),
        voxel_size_m=0.02,
    )
    model = write_tiny_yolo(tmp_path / "tiny.onnx", ("cup", "dog"), [(32, 32, 20, 20, 0, 0.9)])
    folder = write_seven_scenes(tmp_path / "frames")
    return ["bench", "perception", str(folder), "--roi", str(tmp_path / "roi.npz"), "--detector", str(model)]


def test_the_command_prints_its_figures(arguments, capsys):
    arguments += ["--set", "threads=1", "--task", "Find the mug=mug", "--task", "Find the dog="]
    assert main([*arguments, "--json"]) == 0
    tasks = json.loads(capsys.readouterr().out)["tasks"]
    assert [(task["task"], task["objects"]) for task in tasks] == [("Find the mug", ["mug"]), ("Find the dog", [])]
    assert set(tasks[0]["stages"]) == {"detected", "related", "confirmed", "tracked", "completed"}
    assert tasks[1]["stages"]["completed"]["marked_frames"] == 0
    assert main(arguments) == 0
    assert "task: Find the dog\n" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--task", "Find the mug"], "expected a task and its objects"),
        (["--task", "Find the mug=cup"], "expected names among mug; got cup"),
    ],
)
def test_invalid_tasks_are_errors(arguments, options, message, capsys):
    assert main([*arguments, *options]) == 2
    assert message in capsys.readouterr().err


def test_it_measures_a_detector(arguments, capsys):
    assert main(arguments[:-2]) == 2
    assert "--detector: expected a model file" in capsys.readouterr().err
