"""The core works without each package beside it, and a command of an absent package says which one it needs."""

import json
from pathlib import Path

import numpy as np
import pytest
from other_process import environment_without, run_python
from tiny_sequences import FEW_GAUSSIANS, write_tum

pytest.importorskip("gausslite.render._kernels", reason="the native kernels are not built")

pytestmark = pytest.mark.slow

SUPPORT = Path(__file__).resolve().parents[1] / "support"
SEQUENCE = "../fr1_cup"
"""A folder in the layout of TUM, whose camera is known by its name."""
WORKING = (
    ("gausslite", "--help"),
    ("gausslite", "map", SEQUENCE, *FEW_GAUSSIANS, "--roi", "../regions.npz", "--out", "roi"),
    ("gausslite", "map", SEQUENCE, *FEW_GAUSSIANS, "--out", "uniform"),
    ("gausslite_fusion_server", "--store", "fusion.sqlite"),
    ("gausslite_agent",),
)
"""What a core without the packages beside it does."""
_TASK = ("--task", "Find the cup", "--out", "refused")
_MAP = ("gausslite", "map", SEQUENCE, *_TASK)
COMMANDS: dict[str, tuple[tuple[str, ...], ...]] = {
    "gausslite_language": (("gausslite", "parse", "Find the cup"), _MAP, ("gausslite_parser",)),
    "gausslite_detectors": (("gausslite", "models", "list"), _MAP, (*_MAP, "--detector", "../detector.onnx")),
    "gausslite_selection": (("gausslite", "map", SEQUENCE, "--set", "target-at=0,0,1", "--out", "refused"),),
    "gausslite_calibration": (
        ("gausslite", "calibrate", SEQUENCE),
        ("gausslite", "map", SEQUENCE, "--out", "refused", "--set", "camera-correction=readout=0.01"),
    ),
    "gausslite_poses": (
        ("gausslite", "map", SEQUENCE, "--out", "refused", "--poses", "track"),
        ("gausslite", "map", SEQUENCE, "--out", "refused", "--set", "pose-prior=0.01,0.5"),
    ),
    "gausslite_objects": (("gausslite", "diff", "a", "b"), (*_MAP, "--prior", "a")),
    "gausslite_places": (("gausslite", "diff", "a", "b"), (*_MAP, "--prior", "a")),
    "gausslite_paging": (("gausslite", "map", SEQUENCE, "--out", "refused", "--set", "disk-mb=10"),),
    "gausslite_relocalisation": (),
    "gausslite_gpu": (("gausslite", "map", SEQUENCE, "--out", "refused", "--set", "rasterizer=cuda"),),
    "gausslite_cluster": (("gausslite_fusion_server", "--store", "postgresql://nowhere.invalid/maps"),),
    "gausslite_evaluation": (("gausslite", "eval", "map.ply", SEQUENCE),),
    "gausslite_export": (("gausslite", "export", "a", "--to", "ply"),),
    "gausslite_recorders": (("gausslite", "map", "../frames", "--out", "refused"),),
    "gausslite_refinement": (),
    "gausslite_link": (
        ("gausslite", "view", "127.0.0.1:1"),
        ("gausslite_agent", "--listen", "127.0.0.1:0", "--fusion", "127.0.0.1:1", "--set", "team-map=vote"),
    ),
    "gausslite_render": (("gausslite", "render", "map.ply", "--poses", "a", "--out", "refused"),),
    "gausslite_operations": (
        ("gausslite", "status", "127.0.0.1:1"),
        ("gausslite", "fuse", "a.ply", "b.ply", "--out", "fused.ply"),
        ("gausslite_fusion_server", "verify", "fusion.sqlite"),
        ("gausslite_fusion_server", "--listen", "127.0.0.1:0", "--metrics", "127.0.0.1:0"),
    ),
    "gausslite_demo": (("gausslite", "demo", "--out", "refused"), ("gausslite", "doctor")),
    "gausslite_mcp": (("gausslite", "mcp", "a"),),
    "gausslite_view": (
        ("gausslite", "report", "a"),
        ("gausslite", "view", "a"),
        ("gausslite", "map", SEQUENCE, "--out", "refused", "--set", "view=0"),
        ("gausslite_agent", "--listen", "127.0.0.1:0", "--set", "view=0"),
        ("gausslite_fusion_server", "--listen", "127.0.0.1:0", "--view", "0"),
    ),
    "gausslite_ros": (("gausslite", "map", "bag:run.mcap", "--out", "refused"),),
    "gausslite_sim": (("gausslite", "map", "sim:home", "--out", "refused"),),
    "gausslite_bench": (("gausslite", "bench", "quality"),),
}
"""What each package adds to the command lines."""


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a sequence, its regions, and a file that is no model."""
    folder = tmp_path_factory.mktemp("removed")
    write_tum(folder / Path(SEQUENCE).name)
    voxels = np.stack(np.meshgrid(range(90, 120), range(-10, 10), range(20)), axis=-1).reshape(-1, 3)
    np.savez(folder / "regions.npz", voxel_size_m=0.1, cup_1=voxels.astype(np.int32))
    (folder / "detector.onnx").write_bytes(b"no model")
    (folder / "frames").mkdir()
    (folder / "frames" / "frame-000000.color.png").touch()
    return folder


@pytest.mark.parametrize("hidden", [*COMMANDS, ",".join(COMMANDS)], ids=[*COMMANDS, "all"])
def test_the_core_works_without_a_package_whose_commands_name_it(hidden: str, inputs: Path) -> None:
    commands = [command for package in hidden.split(",") for command in COMMANDS[package]]
    folder = inputs / hidden[:40]
    folder.mkdir()
    arguments = SUPPORT / "removed_packages.py", folder, json.dumps(WORKING), json.dumps(commands)
    done = run_python(*arguments, environment=environment_without(hidden))
    assert done.returncode == 0, done.stderr
    results = json.loads(done.stdout)
    assert [result for result in results["working"] if result["code"] != 0] == []
    for result in results["refused"]:
        assert result["code"] == 2, result
        assert "Traceback" not in "".join(result["messages"]), result
        assert any(package in result["messages"][-1] for package in hidden.split(",")), result
