"""What a user can get wrong with `gausslite map`: one line that names it, exit code 2, and no map."""

import struct
from pathlib import Path

import pytest
from tiny_sequences import write_seven_scenes

from gausslite.cli.main import main

pytest.importorskip("gausslite.render._kernels", reason="the native kernels are not built")

EMPTY_SAFETENSORS = struct.pack("<Q", 2) + b"{}"
BALL = ("--set", "target-at=0,0,2,0.4")
WITHOUT_ESTIMATES = ("--set", "register-depth=none", "--set", "pose-prior=none")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--set", "world-frame=a\nb"), "world-frame: expected no line breaks"),
        (("--task", "Find the mug"), "expected --detector FILE.onnx"),
        (("--policy", "task"), "--policy task: expected a task"),
        (
            ("--task", "Find the mug", "--set", "task-at=4:Find the chair", "--set", "task-at=4:Find the table"),
            "task-at: expected one task for a frame, got 2 for 4",
        ),
        (
            ("--set", "target-at=0,0,50"),
            "target 0,0,50: expected a point on a surface that a frame shows, none shows it",
        ),
        (("--set", "target-at=0,0"), "target-at"),
        ((*BALL, "--set", "save-state={folder}"), "expected the name of a file, got a folder"),
        *(
            (
                (*BALL, "--set", f"save-state={{folder}}/out/{name}"),
                f"{name}: expected a name other than that of a result in",
            )
            for name in ("map.ply", "report.json", "preview.png")
        ),
        ((*BALL, "--set", "resume={folder}/none.state"), "none.state"),
        *(((*BALL, "--set", f"resume={{folder}}/{number}.state"), f"{number}.state") for number in range(4)),
    ],
)
def test_a_wrong_option_is_one_line(
    options: tuple[str, ...], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sequence = write_seven_scenes(tmp_path / "kitchen")
    for number, contents in enumerate((b"", b"remember the milk", EMPTY_SAFETENSORS[:8], EMPTY_SAFETENSORS)):
        (tmp_path / f"{number}.state").write_bytes(contents)
    command = ["map", str(sequence), "--max-gaussians", "150", *WITHOUT_ESTIMATES, "--out", str(tmp_path / "out")]
    assert main([*command, *(word.replace("{folder}", str(tmp_path)) for word in options)]) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert message in line
    assert not (tmp_path / "out" / "map.ply").exists()


@pytest.mark.parametrize(("source", "out", "name"), [("", "out", "SOURCE"), ("kitchen", "", "--out")])
def test_an_empty_path_is_one_line(source: str, out: str, name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["map", source, "--out", out]) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert line.startswith(f"gausslite: {name}: expected a ")
    assert "empty" in line
