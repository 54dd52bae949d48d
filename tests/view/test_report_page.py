"""`gausslite report`: the page is valid, self-contained and escaped; runs are side by side; errors are one line."""

import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from browser import open_browser
from run_folders import MUG, TASK, write_run, write_team

from gausslite.cli.main import main
from gausslite_view.report_parts import read_results
from gausslite_view.report_pictures import shared_views

pytest.importorskip("gausslite.render._kernels", reason="the native kernels are not built")
VOID = {"meta", "img", "br", "hr", "link", "input"}
HOSTILE = '<script>alert("x")</script>\' onload=y & \x00\ud800'


class Page(HTMLParser):
    """Parses a page and checks that every element is closed in order."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.addresses: list[str] = []
        self.texts: list[str] = []
        self._open: list[str] = []
        self.feed(text)
        self.close()
        assert self._open == []

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.addresses += [value or "" for name, value in attributes if name in ("src", "href", "action", "data")]
        assert not [name for name, _ in attributes if name.startswith("on")]
        if tag not in VOID:
            self._open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self._open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.texts.append(data)


def report(*folders: Path, out: Path) -> Page:
    assert main(["report", *map(str, folders), "--out", str(out)]) == 0
    text = out.read_text(encoding="utf-8")
    assert text.startswith("<!doctype html>\n")
    return Page(text)


def table_rows(path: Path) -> dict[str, list[str]]:
    """Return the cells of every row with a label."""
    rows = re.findall(r"<tr><th>([^<]*)</th>((?:<td>[^<]*</td>)+)</tr>", path.read_text(encoding="utf-8"))
    return {label: re.findall(r"<td>([^<]*)</td>", cells) for label, cells in rows}


def test_the_default_page_is_in_the_folder_and_needs_no_other_file(tmp_path, capsys):
    run = write_run(tmp_path / "run", task=TASK)
    assert main(["report", str(run), "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    path = run / "report.html"
    assert (printed["file"], printed["maps"], printed["bytes"]) == (str(path), ["run"], path.stat().st_size)
    page = Page(path.read_text(encoding="utf-8"))
    assert page.addresses
    assert all(address.startswith("data:image/jpeg;base64,") for address in page.addresses)
    assert not {"script", "iframe", "object", "embed", "link", "base", "form"} & set(page.tags)
    assert "url(" not in path.read_text(encoding="utf-8")
    assert {"Pick up the mug on the table", "on", "mug-1", "0.25  0.50  1.00", "0.20 × 0.10 × 0.20"} <= set(page.texts)


def test_runs_are_side_by_side_at_the_same_views(tmp_path):
    first = write_run(tmp_path / "first", task=TASK, hz=2.5)
    second = write_run(tmp_path / "second", hz=4.0, peak_rss_mib=300.0)
    (second / "evaluation.json").write_text(json.dumps({"roi_psnr": 25.5, "full_psnr": 21.25, "n_views": 7}))
    frames = second / "frames.csv"
    frames.write_text(frames.read_text().replace("0.2,0\n", "0.2,2\n"))
    page = report(first, second, out=tmp_path / "both.html")
    rows = table_rows(tmp_path / "both.html")
    assert rows["frame rate"] == ["2.50 Hz", "4.00 Hz"]
    assert rows["peak memory"] == ["–", "300 MiB"]
    assert rows["region PSNR"] == ["25.50 dB"]
    assert "<tr><th></th><th>second</th></tr>" in (tmp_path / "both.html").read_text(encoding="utf-8")
    assert rows["Gaussians"] == ["357", "357"]
    headings = re.findall("<h2>([^<]*)</h2>", (tmp_path / "both.html").read_text(encoding="utf-8"))
    assert headings.index("Views") < headings.index("Quality") < headings.index("Map and time")
    captions = [text for text in page.texts if text.endswith(": kappa")]
    assert captions.count("first: kappa") == captions.count("second: kappa") == 2  # at the view and from above
    assert "Frame 3" in page.texts
    assert page.tags.count("polyline") > 4
    # one plot has the size of the final maps, one their growth
    assert page.texts.count("Gaussians after each frame") == 1
    assert page.texts.count("place of the robot: 0 tracked, 1 doubtful, 2 lost") == 1


def test_a_damaged_evaluation_is_one_line_and_leaves_out_the_scores(tmp_path, capsys):
    run = write_run(tmp_path / "run")
    (run / "evaluation.json").write_text('{"roi_psnr": 25')
    assert main(["report", str(run)]) == 0
    (line,) = capsys.readouterr().err.splitlines()
    assert "evaluation.json: expected the scores of `gausslite eval`, got something else" in line
    assert "region PSNR" not in table_rows(run / "report.html")


def test_maps_of_other_world_frames_are_not_rendered_at_the_same_views(tmp_path):
    runs = [write_run(tmp_path / name, world_frame=name) for name in ("a", "b")]
    page = report(*runs, out=tmp_path / "page.html")
    assert page.texts.count("Frame 3") == 2
    assert page.texts.count("photograph") == 2


def test_frames_of_unknown_sequences_are_not_the_same_view(tmp_path):
    same = [write_run(tmp_path / name) for name in ("a", "b")]
    assert report(*same, out=tmp_path / "same.html").texts.count("Frame 3") == 1
    unknown = [write_run(tmp_path / name, source=None) for name in ("c", "d")]
    page = report(*unknown, out=tmp_path / "unknown.html")
    assert page.texts.count("Frame 3") == 2
    assert {" photograph kept by c", " photograph kept by d"} <= set(page.texts)


def test_a_run_is_rendered_at_its_own_pose_of_a_frame_only_in_the_same_sequence(tmp_path):
    first, second = write_run(tmp_path / "a"), write_run(tmp_path / "b")
    keyframes = json.loads((second / "keyframes.json").read_text())
    keyframes["keyframes"][0]["T_world_camera"][0][3] = 0.1
    (second / "keyframes.json").write_text(json.dumps(keyframes))
    runs = read_results([first, second]).runs
    [view] = shared_views(runs)
    assert [view.pose_of(run)[0, 3] for run in runs] == [0.0, 0.1]
    unknown = [replace(run, report={}) for run in runs]
    assert [[view.pose_of(run)[0, 3] for run in unknown] for view in shared_views(unknown)] == [[0.0, 0.0], [0.1, 0.1]]


def test_texts_of_files_are_escaped(tmp_path):
    hostile = {**TASK, "text": HOSTILE, "targets": [HOSTILE], "relations": [{"predicate": HOSTILE, "target": HOSTILE}]}
    run = write_run(
        tmp_path / "<b>run&",
        task=hostile,
        notes=[HOSTILE],
        objects=[{**MUG, "id": '<script>alert("x")</script>'}],
        nouns=[{"noun": HOSTILE, "classes": [HOSTILE], "searched": True}],
        source=HOSTILE,
        stopped_by=HOSTILE,
    )
    page = report(run, out=tmp_path / "page.html")
    assert "script" not in page.tags
    assert "b" not in page.tags
    assert sum('<script>alert("x")' in text for text in page.texts) > 6
    data = (tmp_path / "page.html").read_bytes()
    assert b"\x00" not in data
    assert data.decode("utf-8").count("\ufffd") > 6


@pytest.mark.parametrize("value", [None, 3, "text", [], {}, [1, None, {"a": []}], True])
def test_unexpected_values_in_a_report_are_shown_or_left_out(tmp_path, value):
    names = (
        "task",
        "then",
        "notes",
        "nouns",
        "frames",
        "hz",
        "seconds",
        "size",
        "source",
        "without",
        "ate",
        "stopped_by",
    )
    run = write_run(tmp_path / "run", **dict.fromkeys(names, value))
    report(run, out=tmp_path / "page.html")


def test_a_run_without_photographs_or_poses_has_a_page(tmp_path):
    run = write_run(tmp_path / "run")
    for path in [*(run / "views").iterdir(), run / "trajectory.txt", run / "keyframes.json", run / "frames.csv"]:
        path.unlink()
    page = report(run, out=tmp_path / "page.html")
    assert "From above" in page.texts
    assert "Views" not in page.texts


def test_the_maps_of_a_team_are_columns(tmp_path):
    team = write_team(tmp_path / "team")
    page = report(team, out=tmp_path / "page.html")
    rows = table_rows(tmp_path / "page.html")
    assert rows["region PSNR"] == ["–", "–", "23.00 dB"]
    assert rows["region of agent-a, PSNR"] == ["24.00 dB", "15.00 dB", "23.50 dB"]
    assert (
        "One map for all tasks: the voted map has 23.5 dB PSNR in the region of agent-a, 22.0 dB PSNR in whole images; "
        "agent-a alone has 6.0 dB less in whole images, agent-b alone has 8.5 dB less in the region of agent-a."
    ) in page.texts
    assert rows["sent to the fusion server"] == ["2.5 MB", "2.5 MB", "–", "–"]
    assert rows["share of the map sent"] == ["2 %", "2 %", "–", "–"]
    assert rows["frame rate"] == ["2.50 Hz", "2.50 Hz"]
    assert "team: 000-frame" in page.texts
    assert "What no robot has alone: of vote, 100 % from agent-a, 0 % from agent-b." in page.texts
    assert "vote: agent" in page.texts
    assert {"GaussLite: team", "Find the mug", "on"} <= set(page.texts)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        ({"map.ply": None}, "expected a results folder of `map`, `demo` or an agent"),
        ({"map.ply": b"no map"}, "map.ply"),
        ({"report.json": b"{"}, "report.json: expected the report of a run"),
        ({"keyframes.json": b"{}"}, "keyframes.json"),
        ({"views/000003.png": b"no picture"}, "000003.png: expected a PNG file"),
        ({"views/000003.roi.png": None}, "000003.roi.png: expected a PNG file"),
        ({"frames.csv": b"frame\n1,2"}, "frames.csv: expected the frames of a run"),
    ],
)
def test_a_damaged_run_is_one_line_and_exit_code_2(tmp_path, capsys, damage, message):
    run = write_run(tmp_path / "run")
    for name, content in damage.items():
        (run / name).unlink()
        if content is not None:
            (run / name).write_bytes(content)
    assert main(["report", str(run)]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not (run / "report.html").exists()


def test_only_an_earlier_page_is_replaced(tmp_path, capsys):
    run = write_run(tmp_path / "run")
    before = (run / "map.ply").read_bytes()
    assert main(["report", str(run), "--out", str(run / "map.ply")]) == 2
    assert "is not a report" in capsys.readouterr().err
    assert (run / "map.ply").read_bytes() == before
    assert main(["report", str(run)]) == 0
    assert main(["report", str(run)]) == 0


@pytest.mark.slow
def test_a_browser_shows_the_page_without_requests_or_refusals(tmp_path):
    report(write_run(tmp_path / "a", task=TASK), write_run(tmp_path / "b"), out=tmp_path / "page.html")
    requests: list[str] = []
    messages: list[str] = []
    with open_browser() as context:
        page = context.new_page()
        page.on("request", lambda request: requests.append(request.url))
        page.on("console", lambda message: messages.append(message.text))
        page.goto((tmp_path / "page.html").as_uri())
        widths = page.evaluate("[...document.images].map(image => image.naturalWidth)")
    assert [url for url in requests if not url.startswith(("data:", "file:"))] == []
    assert messages == []
    assert np.all(np.array(widths) > 0)


def test_the_views_of_several_agents_take_turns(tmp_path):
    agents = [write_run(tmp_path / name, source=None) for name in ("a", "b")]
    for agent in agents:
        keyframes = json.loads((agent / "keyframes.json").read_text())
        [first] = keyframes["keyframes"]
        keyframes["keyframes"] = [{**first, "index": index} for index in range(10, 14)]
        (agent / "keyframes.json").write_text(json.dumps(keyframes))
        for index in range(10, 14):
            for suffix in (".png", ".roi.png"):
                (agent / "views" / f"{index:06d}{suffix}").write_bytes(
                    (agent / "views" / f"000003{suffix}").read_bytes()
                )
    views = shared_views(read_results(agents).runs)
    assert sorted((view.image.index, view.recorder) for view in views) == [(10, "a"), (10, "b"), (11, "a"), (11, "b")]


@pytest.mark.slow
def test_a_narrow_window_cuts_no_column(tmp_path):
    runs = [write_run(tmp_path / f"a-rather-long-name-{number}", task=TASK, objects=[MUG]) for number in range(4)]
    report(*runs, out=tmp_path / "page.html")
    with open_browser((390, 800)) as context:
        page = context.new_page()
        page.goto((tmp_path / "page.html").as_uri())
        assert page.evaluate("document.documentElement.scrollWidth") == 390
        wide = (
            "[...document.querySelectorAll('.scroll, .grid')].filter(box => box.scrollWidth > box.clientWidth).length"
        )
        assert page.evaluate(wide) == 0


def test_the_page_begins_with_what_a_run_found_and_how_good_it_is(tmp_path):
    run = write_run(tmp_path / "run", task=TASK, objects=[{**MUG, "min_m": [0.1, 0.4, 0.9]}])
    (run / "evaluation.json").write_text(json.dumps({"roi_psnr": 25.5, "full_psnr": 21.25, "n_views": 7}))
    page = report(run, out=tmp_path / "page.html")
    first = next(text for text in page.texts if text.startswith("run: "))
    assert "for \u201cPick up the mug on the table\u201d it found mug at (0.25, 0.50, 1.00) m" in first
    assert "On 7 scored views its region has 25.50 dB PSNR and the whole images have 21.25 dB." in first
