"""`gausslite map --prior` continues a saved map in its frame, or says that it is another place; `diff` compares."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from run_folders import write_run

from gausslite.cli.main import main
from gausslite.codec.ply import read_ply, read_world_frame
from gausslite.datasets.open import open_source
from gausslite.domain.frame import Frame
from gausslite.domain.pose import transform_of
from gausslite_places.localisation import Localisation, PlaceMap
from gausslite_places.moved_source import MovedSource
from gausslite_places.prior_map import SequenceLocaliser
from gausslite_places.verification import Verification

pytest.importorskip("embreex", reason="simulated homes come with the extra sim")
HOME = "sim:home-2?frames=45&size=160x120&noise=0"


def _map(spec: str, out: Path, *more: str) -> dict[str, Any]:
    options = ["--max-gaussians", "9000", "--iterations", "6", "--set", "threads=1", "--set", "pose-prior=none"]
    assert main(["map", spec, *options, "--out", str(out), *more]) == 0
    report: dict[str, Any] = json.loads((out / "report.json").read_text())
    return report


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the run of a home with a stool."""
    out = tmp_path_factory.mktemp("prior") / "saved"
    _map(HOME, out, "--frames", "0:45:2", "--set", "target-at=3.75,1.55,0.35,0.5")
    return out


@pytest.mark.slow
def test_a_run_continues_a_saved_map_in_its_frame(
    saved: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # an active iteration trains up to four views, so that the saved stool takes twice as long to fade
    more = ("--prior", str(saved), "--iterations", "12")
    report = _map(f"{HOME}&changes=stool:gone,blanket:gone", tmp_path / "next", *more)
    printed = capsys.readouterr()
    assert "localised after" in printed.err
    assert "gone from (3." in printed.out
    prior = report["prior"]
    assert (prior["run"], prior["localised"]) == (str(saved), True)
    np.testing.assert_allclose(prior["T_map_sequence"], np.eye(4), atol=0.05)
    assert report["gaussians"] > len(read_ply(saved / "map.ply"))
    assert read_world_frame(tmp_path / "next" / "map.ply") == read_world_frame(saved / "map.ply")
    assert main(["diff", str(saved), str(tmp_path / "next"), "--json"]) == 0
    for changes in (report["changes"], json.loads(capsys.readouterr().out)["changes"]):
        [change] = changes
        assert change["change"] == "gone"
        np.testing.assert_allclose(change["before_m"], (3.75, 1.55, 0.45), atol=0.2)


@pytest.mark.slow
def test_another_place_is_said_to_be_one(saved: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    report = _map("sim:home-4?frames=8&size=160x120&noise=0", tmp_path / "other", "--prior", str(saved))
    assert "this run begins a map of its own" in capsys.readouterr().err
    assert (report["prior"]["localised"], report["changes"]) == (False, [])
    assert main(["diff", str(saved), str(tmp_path / "other")]) == 2
    assert "expected a map of the place of" in capsys.readouterr().err


@pytest.mark.slow
def test_a_resumed_run_with_a_prior_gives_the_same_map(saved: Path, tmp_path: Path) -> None:
    state = tmp_path / "run.state"
    prior = ("--prior", str(saved))
    _map(HOME, tmp_path / "whole", "--frames", "0:12:2", *prior)
    whole = (tmp_path / "whole" / "map.ply").read_bytes()
    first = _map(HOME, tmp_path / "half", "--frames", "0:6:2", *prior, "--set", f"save-state={state}")
    second = _map(HOME, tmp_path / "rest", "--frames", "0:12:2", "--set", f"resume={state}")
    assert second["prior"]["T_map_sequence"] == first["prior"]["T_map_sequence"]
    whole_report = json.loads((tmp_path / "whole" / "report.json").read_text())
    assert whole_report["prior"]["T_map_sequence"] == first["prior"]["T_map_sequence"]
    assert (tmp_path / "rest" / "map.ply").read_bytes() == whole


def test_a_folder_without_a_run_and_both_options_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    missing, run = str(tmp_path / "missing"), write_run(tmp_path / "run")
    common = ["map", HOME, "--out", str(tmp_path / "out"), "--prior"]
    for arguments, expected in (
        ([*common, missing], "missing/map.ply"),
        ([*common, str(run), "--set", "resume=x.state"], "--prior: expected it without resume"),
        (["map", HOME, "--out", str(run), "--overwrite", "--prior", f"{run}/../run"], "another folder than --out"),
        ([*common, str(run / "map.ply")], "map.ply"),
        (["diff", missing, str(run)], "missing/map.ply"),
    ):
        assert main(arguments) == 2
        message = capsys.readouterr().err
        assert expected in message
        assert message.splitlines()[-1].startswith("gausslite: ")
        assert "Traceback" not in message
    report = json.loads((run / "report.json").read_text())
    endless = [{**found, "first_seen_ns": float("inf")} for found in report["objects"]]
    for name, content, expected in (
        ("report.json", json.dumps({**report, "objects": endless}), "expected a report.json with the run's objects"),
        ("report.json", json.dumps({**report, "objects": 5}), "expected a report.json with a list of objects"),
        ("report.json", '{"objects": [', "expected a run's report.json, got a damaged one"),
        ("keyframes.json", '{"keyframes": []}', "expected a run with map.ply and keyframes.json"),
    ):
        (run / name).write_text(content)
        assert main(["diff", str(run), str(run)]) == 2
        assert expected in capsys.readouterr().err


class _Places(PlaceMap):
    """Answers with given poses in place of those that it finds."""

    def __init__(self, poses: list[np.ndarray | None]) -> None:
        self._poses = iter(poses)

    def localise(self, frame: Frame) -> Localisation | None:
        pose = next(self._poses)
        return None if pose is None else Localisation(pose, 0, 1.0, Verification(pose, 1.0))


def test_two_frames_must_agree_on_the_motion() -> None:
    source = open_source(HOME)
    frames = [source.frame(i) for i in range(5)]
    T, other = transform_of(np.array([1.0, 2.0, 0.0, 0.0, 0.0, 2.0])), transform_of(np.array([3.0, 0, 0, 0, 0, 0]))
    poses = [frame.T_world_camera for frame in frames]
    localiser = SequenceLocaliser(_Places([T @ poses[0], None, other @ poses[2], T @ poses[3], T @ poses[4]]))
    assert localiser.localise(frames[:4]) is None, "another frame contradicts it"
    found = localiser.localise(frames[4:])
    assert found is not None
    np.testing.assert_allclose(found, T, atol=1e-9)
    assert SequenceLocaliser(_Places([T @ poses[0], None, other @ poses[2], None])).localise(frames[:4]) is None


def test_a_moved_source_keeps_its_regions_and_turns_its_up_axis() -> None:
    source = open_source(HOME)
    T = transform_of(np.array([5.0, -2.0, 1.0, 0.0, np.pi / 2, 0.0]))
    moved = MovedSource(source, lambda: T, "map")
    frame, moved_frame = source.frame(3), moved.frame(3)
    np.testing.assert_allclose(moved_frame.T_world_camera, T @ frame.T_world_camera, atol=1e-9)
    np.testing.assert_allclose(moved.trajectory().T_world_camera[3], moved_frame.T_world_camera, atol=1e-9)
    np.testing.assert_allclose(moved.up_axis, T[:3, :3] @ source.up_axis, atol=1e-9)
    assert moved.world_frame == "map"
    for name in ("bed", "stool"):
        mask = source.regions()[name].mask(frame)
        assert np.mean(mask ^ moved.regions()[name].mask(moved_frame)) < 0.001
