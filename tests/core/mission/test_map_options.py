"""`gausslite map`: world frame, negative coordinates, regions of the folder and a corrupt first frame."""

from pathlib import Path

import pytest
from tiny_sequences import WITHOUT_ESTIMATES, write_seven_scenes, write_tum

import gausslite as gl
from gausslite.cli.main import main
from gausslite.codec.ply import read_world_frame
from gausslite.datasets.open import default_world_frame, open_source
from gausslite.mission.results import locked_folder
from gausslite_calibration.depth_registration import find_registration

pytest.importorskip("gausslite.render._kernels", reason="the native kernels are not built")
FRAMES = tuple(range(0, 24, 4))


def map_command(sequence: Path | str, out: Path | str, *more: str) -> int:
    return main(["map", str(sequence), *WITHOUT_ESTIMATES, "--out", str(out), *more])


def test_a_map_names_the_folder_or_the_given_world_frame(tmp_path: Path) -> None:
    sequence = write_seven_scenes(tmp_path / "kitchen", FRAMES)
    for name, more in (("kitchen", ()), ("lab", ("--set", "world-frame=lab")), ("", ("--set", "world-frame="))):
        assert map_command(sequence, tmp_path / "out", "--overwrite", *more) == 0
        assert read_world_frame(tmp_path / "out" / "map.ply") == name


def test_a_missing_earlier_map_is_refused_before_the_recording_is_analysed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sequence = write_seven_scenes(tmp_path / "kitchen", FRAMES)
    assert main(["map", str(sequence), "--prior", str(tmp_path / "none"), "--out", str(tmp_path / "out")]) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert f"{tmp_path / 'none' / 'map.ply'}: cannot read the map: No such file" in line


def test_two_runs_cannot_write_into_one_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sequence = write_seven_scenes(tmp_path / "kitchen", FRAMES)
    with locked_folder(tmp_path / "out"):
        assert map_command(sequence, tmp_path / "out") == 2
        assert "another run writes its results there; choose another --out" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    assert map_command(sequence, tmp_path / "out") == 0


def test_trajectories_through_one_home_share_a_world_frame(tmp_path: Path) -> None:
    pytest.importorskip("embreex")
    for spec, expected in (
        ("sim:home", "sim-home-seed-0"),
        ("sim:home-3?trajectory=1", "sim-home-3-seed-0"),
        ("sim:home-3?trajectory=2&seed=07", "sim-home-3-seed-7"),
    ):
        assert default_world_frame(open_source(spec)) == expected
    folder = write_tum(tmp_path / "fr1\n")
    assert default_world_frame(open_source(str(folder))) == ""


def test_save_ply_names_the_world_frame(tmp_path: Path) -> None:
    sequence = write_seven_scenes(tmp_path / "kitchen", FRAMES)
    settings = gl.MissionSettings(max_gaussians=150, threads=1)
    gaussians = gl.map_sequence(gl.open_sequence(sequence), settings=settings).gaussians
    gl.save_ply(tmp_path / "map.ply", gaussians, world_frame="lab")
    assert read_world_frame(tmp_path / "map.ply") == "lab"


def test_negative_first_coordinates_are_values(tmp_path: Path) -> None:
    sequence = write_seven_scenes(tmp_path / "kitchen", FRAMES)
    assert map_command(sequence, tmp_path / "out", "--set", "target-at=-.1,-2e-1,2,0.4", "--set", "up=-1,0,0") == 0


def test_a_missing_file_of_regions_is_not_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sequence = write_seven_scenes(tmp_path / "kitchen", FRAMES)
    map_command(sequence, tmp_path / "out", "--task", "Find the mug")
    assert "ground-truth regions of" not in capsys.readouterr().err


def test_a_corrupt_first_frame_is_skipped(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    kitchen, tum = write_seven_scenes(tmp_path / "kitchen", FRAMES), write_tum(tmp_path / "fr1", frames=4)
    for folder, path in ((kitchen, kitchen / "frame-000000.color.png"), (tum, tum / "rgb" / "0.png")):
        path.write_bytes(b"not an image")
        out = tmp_path / f"out-{folder.name}"
        assert map_command(folder, out) == 0
        assert "1 corrupt" in capsys.readouterr().out
        assert map_command(folder, tmp_path / "strict", "--set", "strict=true") == 2
        assert path.name in capsys.readouterr().err
    find_registration(open_source(str(kitchen)))
    assert (
        main(["map", str(kitchen), "--set", "threads=1", "--max-gaussians", "150", "--out", str(tmp_path / "auto")])
        == 0
    )


def test_eval_skips_and_counts_corrupt_frames(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sequence, out = write_seven_scenes(tmp_path / "kitchen", FRAMES), tmp_path / "out"
    assert map_command(sequence, out) == 0
    (sequence / "frame-000008.color.png").write_bytes(b"not an image")
    capsys.readouterr()
    command = ["eval", str(out / "map.ply"), str(sequence), "--set", "threads=1"]
    assert main(command) == 0
    printed = capsys.readouterr()
    assert "(skipped: 1 corrupt)" in printed.out
    assert "frame 8 skipped" in printed.err
    assert main([*command, "--json"]) == 0
    assert '"frames_corrupt": 1' in capsys.readouterr().out
    assert main([*command, "--set", "strict=true"]) == 2
