"""The page of `gausslite map` in a real browser: a person points at an object while the run maps."""

import json
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any
from urllib.error import URLError
from urllib.request import urlopen

import pytest
from browser import open_browser, point
from mapping_scenes import wall_frame, with_box
from page_controls import control, text
from tiny_sequences import write_seven_scenes

from gausslite.cli.main import main
from gausslite.codec.state_file import read_state, write_state
from gausslite.domain.errors import InvalidInputError, UnavailableError
from gausslite.domain.relevance import PointedObject
from gausslite.domain.state import encode_text
from gausslite.mission.build import EstimatorFactory, build_task_mapper
from gausslite.mission.schedule import ScheduledTaskMapper, TaskSchedule
from gausslite.mission.settings import MissionSettings, PerceptionSettings, SceneInfo
from gausslite_language.rules import RuleParser

pytest.importorskip("gausslite.render._kernels", reason="the native kernels are not built")
pytest.importorskip("viser")
from gausslite_view.map_page import TaskField
from gausslite_view.mission_view import MissionRequests, MissionView, mission_view
from gausslite_view.pages import open_page

WAIT_S = 60.0
_SOME = 3
SETTINGS = MissionSettings(max_gaussians=2000, iterations=2, threads=1)


def mission(*later: tuple[int, str]) -> ScheduledTaskMapper:
    """A search for a mug without any detector."""
    estimators = EstimatorFactory(PerceptionSettings(), SceneInfo, needs_detector=False)
    graph = RuleParser().parse("Find the mug")
    schedule = TaskSchedule(graph, tuple((frame, RuleParser().parse(text)) for frame, text in later))
    return ScheduledTaskMapper(build_task_mapper(SETTINGS, estimators, graph), schedule, estimators, graph, -1)


@contextmanager
def mapped(view: MissionView, mapped_mission: ScheduledTaskMapper) -> Iterator[list[float]]:
    """Map some frames on another thread, at first and after each request of the page; yield their shares of the region.

    A map that changes in every second would occupy a browser without a GPU.
    """
    shares: list[float] = []
    stopped = threading.Event()

    def map_frames() -> None:
        end = _SOME
        while not stopped.wait(1.0):
            if not view._requests._waiting.empty():
                end = len(shares) + _SOME
            if len(shares) < end:
                graph = mapped_mission.graph
                outcome = mapped_mission.process(with_box(wall_frame(len(shares))))
                shares.append(outcome.roi_share)
                view.update(outcome)
                # a request that came during the frame is answered by now
                if mapped_mission.graph is not graph:
                    end = len(shares) + _SOME

    thread = threading.Thread(target=map_frames)
    thread.start()
    try:
        yield shares
    finally:
        stopped.set()
        thread.join(WAIT_S)


def wait_until(condition: Callable[[], bool], tab: Any) -> None:
    deadline_s = time.monotonic() + WAIT_S
    while not condition():
        assert time.monotonic() < deadline_s
        tab.wait_for_timeout(100)


@pytest.mark.slow
def test_a_click_on_the_camera_image_is_a_target_until_it_is_left_out() -> None:
    with open_browser((1200, 900)) as browser:
        searched = mission()
        page = open_page(0, "test")
        view = MissionView(page, searched)
        try:
            with mapped(view, searched) as shares:
                tab = browser.new_page()
                tab.goto(page.url)
                tab.get_by_text("Newest keyframe").wait_for()
                point(tab, "Point in the image", "wall", (0.5, 0.5))
                tab.get_by_text("is a target").wait_for()
                tab.locator("input[role=combobox][value^='wall']").wait_for()
                # the next frame is the first one with it
                wait_until(lambda: shares[-1] > 0, tab)
                assert searched.graph is not None
                assert (searched.graph.targets, searched.graph.pointed) == (("mug", "wall"), ("wall",))
                tab.get_by_role("button", name="Not this one").click()
                tab.get_by_text("is left out").wait_for()
                control(page, "Task").value = "Find the lamp"
                tab.get_by_role("button", name="Assign task").click()
                tab.get_by_text("assigned: targets lamp").wait_for()
            assert searched.process(wall_frame(len(shares))).roi_share == 0
            assert searched.graph.targets == ("lamp",)
        finally:
            view.end()
            page.close()


def test_the_page_is_answered_between_frames_and_refused_after_the_mission() -> None:
    searched = mission()
    requests = MissionRequests(searched)
    searched.process(wall_frame())
    asked = threading.Thread(
        target=lambda: answers.append(requests.render(wall_frame().camera, wall_frame().T_world_camera))
    )
    answers: list[object] = []
    asked.start()
    while asked.is_alive():
        requests.answer()
    assert len(answers) == 1
    requests.end()
    with pytest.raises(UnavailableError, match="the mission has ended"):
        requests.render(wall_frame().camera, wall_frame().T_world_camera)


def test_what_a_person_points_at_is_meant_until_the_next_task() -> None:
    searched = mission((2, "Find the chair"))
    with pytest.raises(InvalidInputError, match="expected a mapped frame first"):
        searched.point_at([PointedObject(points_px=((32.0, 24.0),))])
    assert searched.process(with_box(wall_frame())).roi_share == 0
    graph = searched.point_at([PointedObject(points_px=((32.0, 24.0),), noun="mug")])
    assert graph.targets == ("mug",)
    assert searched.process(with_box(wall_frame(1))).roi_share > 0
    assert searched.process(with_box(wall_frame(2))).roi_share == 0
    assert searched.graph is not None
    assert searched.graph.targets == ("chair",)


def test_a_task_of_a_person_is_meant_until_the_next_scheduled_one() -> None:
    searched = mission((2, "Find the chair"))
    searched.process(with_box(wall_frame()))
    searched.point_at([PointedObject(points_px=((32.0, 24.0),), noun="mug")])
    lamp = RuleParser().parse("Find the lamp")
    (warning,) = searched.assign(lamp).warnings
    assert "'lamp'" in warning
    assert searched.process(with_box(wall_frame(1))).roi_share == 0
    assert searched.graph == lamp
    assert [(frame, graph.targets) for frame, graph in searched.schedule.switches] == [(2, ("chair",)), (1, ("lamp",))]
    searched.process(with_box(wall_frame(2)))
    assert searched.graph.targets == ("chair",)


def test_a_keyframe_that_was_shown_can_be_pointed_at_when_newer_ones_have_replaced_it() -> None:
    searched, indices = mission(), range(80)
    shown = 0
    for index in indices:
        searched.process(with_box(wall_frame(index)))
        if index == 3:
            view = searched.mapper.camera_view()
            assert view is not None
            shown = view.frame_index
    on_pixel = ((32.0, 24.0),)
    kept = [keyframe.frame.index for keyframe in searched.mapper.keyframes()]
    assert shown not in kept
    with pytest.raises(InvalidInputError, match="expected a keyframe that is kept"):
        searched.point_at(
            [PointedObject(points_px=on_pixel, frame_index=next(i for i in indices if i not in {*kept, shown}))]
        )
    searched.point_at([PointedObject(points_px=on_pixel, frame_index=shown, noun="mug")])
    assert searched.process(with_box(wall_frame(len(indices)))).roi_share > 0


def test_a_run_without_a_task_gets_none_later() -> None:
    estimators = EstimatorFactory(PerceptionSettings(), SceneInfo)
    uniform = ScheduledTaskMapper(
        build_task_mapper(MissionSettings(policy="uniform", threads=1), estimators, []),
        TaskSchedule(None),
        estimators,
        None,
        -1,
    )
    with pytest.raises(InvalidInputError, match="expected a run with a task"):
        uniform.point_at([PointedObject(points_px=((32.0, 24.0),))])
    with pytest.raises(InvalidInputError, match="expected a run that began with one"):
        uniform.assign(RuleParser().parse("Find the mug"))


def test_a_resumed_run_keeps_what_a_person_has_pointed_at(tmp_path: Path) -> None:
    sequence, state, out = write_seven_scenes(tmp_path / "kitchen"), tmp_path / "run.state", tmp_path / "out"
    common = ["map", str(sequence), "--task", "Find the mug", "--max-gaussians", "150", "--out", str(out)]
    keys = ["threads=1", "register-depth=none", "pose-prior=none", "view=0"]
    options = [*common, *(part for key in keys for part in ("--set", key))]
    assert main([*options, "--set", f"save-state={state}"]) == 3
    write_state(state, {**read_state(state), "extra/pointed": encode_text("wall")})
    write_seven_scenes(tmp_path / "later" / "kitchen", (0, 4, 8, 12))
    options[1] = str(tmp_path / "later" / "kitchen")
    assert main([*options, "--set", f"resume={state}"]) == 3
    assert json.loads((out / "report.json").read_text())["targets"] == ["mug", "wall"]


def test_the_page_is_there_before_the_mission_and_refuses_after_it(capsys: pytest.CaptureFixture[str]) -> None:
    with mission_view(0) as begin:
        url = capsys.readouterr().err.split()[-1]
        with urlopen(url) as answer:
            assert answer.status == 200
        begin(mission())
    pytest.raises(URLError, urlopen, url)


def test_the_current_task_stands_on_the_page_also_while_the_field_has_another() -> None:
    searched = mission()
    with closing(open_page(0, "test")) as page:
        view = MissionView(page, searched)
        control(page, "Task").value = "Find the qqq"
        assert "task: Find the mug" in text(page)
        searched.assign(RuleParser().parse("Find the lamp"))
        view.update(searched.process(wall_frame()))
        assert "task: Find the lamp" in text(page)
        view.end()


def test_a_task_that_may_not_be_found_names_the_one_that_it_replaces() -> None:
    searched = mission()
    with closing(open_page(0, "test")) as page:
        field = TaskField(page.server.gui, lambda task: searched.assign(RuleParser().parse(task)), "Find the mug")
        for task, replaced in (("Find the lamp", "Find the mug"), ("asdf", ""), ("Find the vase", "Find the lamp")):
            field.text.value = task
            field.press()
            assert (f"it replaces the task: {replaced}" in text(page)) is bool(replaced)
