"""Model files are listed and inspected, and each has a source whose commands can be pasted."""

from pathlib import Path

import pytest
from tiny_yolo import write_tiny_yolo

from gausslite.cli.main import main
from gausslite_detectors.models import CATALOGUE, entry_named


def test_the_command_lists_and_inspects(tmp_path, capsys):
    path = write_tiny_yolo(tmp_path / "yolo.onnx", ["cup"], [])
    assert main(["models", "list"]) == 0
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()] == [entry.name for entry in CATALOGUE]
    assert main(["models", "inspect", str(path)]) == 0
    printed = capsys.readouterr().out
    for expected in ("YOLO-seg or FastSAM", "images [1, 3, 64, 64] float", "CPU", "classes   1: cup\n"):
        assert expected in printed
    path.write_bytes(path.read_bytes()[:-1])
    assert main(["models", "inspect", str(path)]) == 2
    assert main(["models", "source", "dino"]) == 2
    [damaged, unknown] = capsys.readouterr().err.splitlines()
    assert "truncated" in damaged
    assert "expected one of rf-detr-seg, grounding-dino, " in unknown


def test_catalogue_names_and_files_are_distinct():
    assert len({each.name for each in CATALOGUE}) == len({each.file_name for each in CATALOGUE}) == len(CATALOGUE)


@pytest.mark.parametrize("name", [entry.name for entry in CATALOGUE])
def test_every_file_has_a_source_whose_commands_can_be_pasted(capsys, name):
    found = entry_named(name)
    assert main(["models", "source", name]) == 0
    printed = capsys.readouterr().out
    assert found.project
    assert f"licence   {found.licence}\n" in printed
    assert printed.endswith(f"export:\n{found.export}\n")
    assert "://" not in printed
    for command in found.export.split('python -c "')[1:]:
        compile(command.split('"')[0], name, "exec")
    for command in found.export.splitlines():
        if command.startswith("tools/"):
            assert (Path(__file__).resolve().parents[2] / command.split()[0]).is_file()
