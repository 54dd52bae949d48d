"""What `gausslite map` and `gausslite eval` write for the report."""

import json
from pathlib import Path

import numpy as np
import pytest
from tiny_sequences import HEIGHT, WIDTH, WITHOUT_ESTIMATES, write_seven_scenes

from gausslite.cli.main import main
from gausslite.codec.run_files import read_keyframe_views
from gausslite_view.timeline import read_timeline
from gausslite_view.view_images import read_view_images

pytest.importorskip("gausslite.render._kernels", reason="the native kernels are not built")
FRAMES = tuple(range(0, 40, 4))


@pytest.fixture
def kitchen(tmp_path: Path) -> Path:
    return write_seven_scenes(tmp_path / "kitchen", FRAMES)


def map_region(sequence: Path, out: Path, *more: str) -> None:
    region = ("--set", "target-at=0,0,2,0.4", "--test-every", "5")
    assert main(["map", str(sequence), *WITHOUT_ESTIMATES, *region, "--out", str(out), *more]) == 0


def test_map_writes_photographs_of_keyframes_and_a_row_for_each_frame(kitchen: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    map_region(kitchen, out)
    images = read_view_images(out)
    by_index = {view.index: view for view in read_keyframe_views(out)}
    assert 1 <= len(images) <= 4
    for image in images:
        assert image.photograph.shape == (HEIGHT, WIDTH, 3)
        assert np.count_nonzero(image.roi) == by_index[image.index].roi_pixels
    assert any(image.roi.any() for image in images)
    timeline, report = read_timeline(out), json.loads((out / "report.json").read_text())
    assert len(timeline["frame"]) == report["frames"] == 8
    assert set(timeline["frame"]) < set(FRAMES)
    assert timeline["iterations"].sum() == report["iterations"]
    assert timeline["gaussians"][-1] == report["gaussians"]
    np.testing.assert_allclose(timeline["roi_share"].mean(), report["roi_share"], rtol=1e-4)


@pytest.mark.slow
def test_saved_scores_are_in_the_report_until_the_map_is_replaced(
    kitchen: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    map_region(kitchen, out)
    assert main(["report", str(out)]) == 0
    assert "The maps were not scored" in (out / "report.html").read_text(encoding="utf-8")
    capsys.readouterr()
    score = ["eval", str(out / "map.ply"), str(kitchen), "--set", "threads=1", "--save-scores"]
    assert main([*score, "--test-every", "5", "--json"]) == 0
    scores = json.loads(capsys.readouterr().out)
    views = {"source": str(kitchen), "frames": ":", "test_every": 5}
    assert json.loads((out / "evaluation.json").read_text()) == {**scores, **views}
    assert main(["report", str(out)]) == 0
    page = (out / "report.html").read_text(encoding="utf-8")
    assert f"<td>{scores['full_psnr']:.2f} dB</td>" in page
    assert "no map was trained on them" in page
    assert main([*score, "--test-every", "1"]) == 0
    assert main(["report", str(out)]) == 0
    assert "also trained the map may be among them for out" in (out / "report.html").read_text(encoding="utf-8")
    map_region(kitchen, out, "--overwrite")
    assert not (out / "evaluation.json").exists()
