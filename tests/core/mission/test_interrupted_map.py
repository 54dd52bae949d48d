"""An interrupted mapping run keeps its results and can be resumed."""

import json
import signal
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from signals import hangup
from tiny_sequences import WITHOUT_ESTIMATES, write_seven_scenes

from gausslite.cli import map_command
from gausslite.cli.main import main
from gausslite.codec.state_file import read_state
from gausslite.domain.frame import Frame
from gausslite.mapping.poses import PoseTable
from gausslite.mission.runner import FrameStream, OnCorrupt
from gausslite.process import DeferredInterrupt
from gausslite_recorders.sevenscenes import SevenScenesSource

pytest.importorskip("gausslite.render._kernels", reason="the native kernels are not built")


def mapped(sequence: Path, out: Path, *more: str) -> int:
    # without estimates, because these tests count which frames are read
    region = ("--set", "target-at=0,0,2,0.4")
    return main(["map", str(sequence), *WITHOUT_ESTIMATES, *region, "--out", str(out), *more])


@pytest.mark.parametrize(
    ("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), pytest.param(signal.SIGHUP, 143, marks=hangup)]
)
def test_a_signal_ends_the_run_after_the_current_frame_and_it_can_be_resumed(
    number: signal.Signals,
    code: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    sequence = write_seven_scenes(tmp_path / "kitchen", tuple(range(0, 24, 4)))
    state = str(tmp_path / "run.state")
    assert mapped(sequence, tmp_path / "whole") == 0
    read = FrameStream.frames

    def read_and_raise_signal(stream: FrameStream, on_corrupt: OnCorrupt | None = None) -> Iterator[Frame]:
        for position, frame in enumerate(read(stream, on_corrupt)):
            if position == 2:
                signal.raise_signal(number)
            yield frame

    with monkeypatch.context() as patched:
        patched.setattr(FrameStream, "frames", read_and_raise_signal)
        assert mapped(sequence, tmp_path / "first", "--set", f"save-state={state}") == code
    last_line = capsys.readouterr().err.splitlines()[-1]
    kept = f"3 frames are mapped; map.ply, report.json and preview.png are in {tmp_path / 'first'}"
    assert last_line.endswith(f"ed: {kept}; continue with --set resume={state}")
    report = json.loads((tmp_path / "first" / "report.json").read_text())
    assert (report["frames"], report["stopped_by"]) == (3, "interrupted")
    assert mapped(sequence, tmp_path / "rest", "--set", f"resume={state}") == 0
    assert (tmp_path / "rest" / "map.ply").read_bytes() == (tmp_path / "whole" / "map.ply").read_bytes()


def test_a_signal_while_results_are_written_loses_none_of_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    sequence = write_seven_scenes(tmp_path / "kitchen")
    write = map_command.write_poses

    def write_and_raise_signal(folder: Path, poses: PoseTable, motion: np.ndarray | None) -> None:
        signal.raise_signal(signal.SIGTERM)
        write(folder, poses, motion)

    assert mapped(sequence, tmp_path / "whole") == 0
    monkeypatch.setattr(map_command, "write_poses", write_and_raise_signal)
    assert mapped(sequence, tmp_path / "out") == 143
    assert capsys.readouterr().err.splitlines()[-1].startswith("gausslite: terminated: all frames are mapped")
    names = [sorted(path.name for path in (tmp_path / name).iterdir()) for name in ("whole", "out")]
    assert names[0] == names[1]


def test_a_second_ctrl_c_interrupts_at_once_unless_a_launcher_repeats_it(monkeypatch: pytest.MonkeyPatch) -> None:
    before = signal.getsignal(signal.SIGINT)
    with DeferredInterrupt() as interrupt:
        # launchers send it to the whole group, then SIGTERM after some seconds
        for number in (signal.SIGINT, signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            signal.raise_signal(number)
        assert type(interrupt.pending_exception) is KeyboardInterrupt
        monkeypatch.setattr("gausslite.process._IMPATIENCE_S", -1.0)
        signal.raise_signal(signal.SIGTERM)
        pytest.raises(KeyboardInterrupt, signal.raise_signal, signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is before


def test_a_resumed_run_without_new_frames_saves_its_state_again(tmp_path: Path) -> None:
    sequence = write_seven_scenes(tmp_path / "kitchen")
    first, second = tmp_path / "first.state", tmp_path / "second.state"
    assert mapped(sequence, tmp_path / "out", "--set", f"save-state={first}") == 0
    assert mapped(sequence, tmp_path / "again", "--set", f"resume={first}", "--set", f"save-state={second}") == 0
    before, after = read_state(first), read_state(second)
    assert before.keys() == after.keys()
    assert all(np.array_equal(before[name], after[name]) for name in before)


def test_an_interrupt_during_the_calibration_leaves_no_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    sequence = write_seven_scenes(tmp_path / "kitchen")
    monkeypatch.setattr(SevenScenesSource, "frame", lambda *_: signal.raise_signal(signal.SIGINT))
    out = tmp_path / "out"
    assert (
        main(["map", str(sequence), "--set", "threads=1", "--out", str(out), "--set", f"save-state={out / 'state'}"])
        == 130
    )
    assert capsys.readouterr().err.splitlines()[-1].startswith("gausslite: interrupted")
    assert not out.exists()
