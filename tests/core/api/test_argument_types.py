"""Arguments of wrong types: one error that names the argument, what is right and what was received."""

import json
import re
import subprocess
import sys

import pytest

WRONG = {
    'gl.map_sequence("sim:home")': r"source: expected a sequence, pass gausslite.open_sequence\(...\), got str 'sim",
    'gl.map_sequence(home, size="320x240")': r"size: expected \(width, height\) in pixels .*got str '320x240'",
    "gl.map_sequence(home, size=(320.0, 240))": r"size: expected \(width, height\)",
    "gl.map_sequence(home, size=(320,))": r"size: expected \(width, height\)",
    "gl.map_sequence(home, frames=5)": r'frames: expected text such as "0:100" .*got int 5',
    "gl.map_sequence(home, 5)": "task: expected a sentence as text, got int 5",
    "gl.map_sequence(home, settings={})": "settings: expected gausslite.MissionSettings.*got dict",
    'gl.map_sequence(home, perception="x.onnx")': "perception: expected gausslite.PerceptionSettings",
    'gl.map_sequence(home, regions=["mug"])': "regions: expected a list of regions .*got str 'mug'",
    "gl.map_sequence(home, regions=5)": "regions: expected a list of regions .*got int 5",
    'gl.map_sequence(home, settings=gl.MissionSettings("paper"))': "'paper' expects a task or regions",
    'home.frame(0, "320x240")': r"size: expected \(width, height\)",
    'gl.MissionSettings(max_gaussians="5")': "max_gaussians: expected a whole number, got str '5'",
    "gl.MissionSettings(seed=None)": "seed: expected a whole number, got NoneType",
    'gl.MissionSettings(rate_hz="4")': "rate_hz: expected a number, got str '4'",
    "gl.MissionSettings(policy=5)": "policy: expected text, got int 5",
    'gl.FusionClient("nonsense")': "FusionClient address: expected HOST:PORT or unix:PATH, got 'nonsense'",
    'gl.AgentClient("host:0")': "AgentClient address: expected the port",
    "gl.SceneInfo(up_axis=(0, 0, 0))": r"up_axis: expected three numbers of length 1 .*got \(0, 0, 0\)",
    "gl.SceneInfo(up_axis=(0, 0, 2))": "up_axis: expected three numbers of length 1",
    'gl.SceneInfo(up_axis="up")': "up_axis: expected three numbers of length 1 .*got 'up'",
    "gl.Camera(300, 300, 160, 120, 320.0, 240)": "camera width_px: expected a whole number, got float 320.0",
    "dataclasses.replace(frame, capture_time_ns=1.5e9)": "frame capture_time_ns: expected a whole number, got float",
    "dataclasses.replace(frame, index=0.5)": "frame index: expected a whole number, got float 0.5",
    "gl.AgentClient(50053)": "AgentClient address: expected HOST:PORT or unix:PATH as text, got int",
    "gl.load_ply(None)": "path: expected str or PathLike, got NoneType None",
    "gl.save_ply(3, frame)": "path: expected str or PathLike, got int 3",
    'gl.save_ply("x.ply", [])': "gaussians: expected Gaussians, got list",
    'gl.render_view("map.ply", frame.camera, frame.T_world_camera)': "gaussians: expected Gaussians, got str",
    'gl.render_view(empty, frame.camera, "here")': "T_world_camera: expected a 4x4 matrix of numbers",
    "gl.render_view(empty, frame.camera, [[1], [2, 3]])": "T_world_camera: expected a 4x4 matrix of numbers",
    'gl.render_view(empty, frame.camera, frame.T_world_camera, threads="two")': "threads: expected a whole",
    "gl.render_view(empty, (320, 240), frame.T_world_camera)": "camera: expected Camera, got tuple",
    "gl.region_on_image(0, [(1, 2)])": "frame: expected Frame, got int 0",
    "gl.region_at(2.0, home)": "point_m: expected tuple or list or ndarray, got float",
    "gl.region_at((1, 2), [frame])": "point_m: expected 3 numbers each, got tuple",
    "gl.region_on_image(frame, [(1, 2, 3)])": "points_px: expected 2 numbers each, got tuple",
    'gl.ask([], "mug", up_axis="z")': "up axis: expected a finite vector that is not zero, got z",
    'gl.ask(empty, "mug")': "objects: expected Iterable, got Gaussians",
    'gl.ask(["mug"], "mug")': r"objects\[0\]: expected ObjectLandmark, got str 'mug'",
    "gl.ask([], 5)": "question: expected str, got int 5",
    'gl.Camera("a", 1, 1, 1, 2, 2)': "camera fx_px: expected a number, got str 'a'",
    'gl.CameraMotion("fast")': "twist: expected Twist, got str 'fast'",
    'gl.Lens("fisheye", (0.0,) * 4)': "model: expected LensModel, got str 'fisheye'",
    'gl.Lens(gl.LensModel.FISHEYE, "0,0,0,0")': "coefficients: expected tuple or list or ndarray, got str",
    'gl.BallRegion((0, 0, "z"), 1.0)': "ball: expected a number, got str 'z'",
    "gl.BallRegion((0, 0), 1.0)": "ball: expected a centre within",
    'gl.PoseExposurePrior("0.1")': "pose prior translation_m: expected a number, got str",
    "gl.DepthRegistration((500, 500, 320, 240))": "intrinsics: expected FileIntrinsics, got tuple",
    'dataclasses.replace(frame, camera="kinect")': "camera: expected Camera, got str 'kinect'",
    "home.frame(1.5)": "position: expected a whole number, got float 1.5",
    'gl.create_mapper(gl.SceneInfo()).process("a.png")': "frame: expected Frame, got str 'a.png'",
    'gl.AgentClient("host:1").assign_task(5)': "task: expected TaskGraph, got int 5",
    'gl.FusionClient("host:1").query_objects(5)': "noun: expected str, got int 5",
    'gl.ParserClient("host:1").parse(None)': "text: expected str, got NoneType None",
}
PROGRAM = """
import dataclasses, json, sys
import gausslite as gl
from gausslite.domain.errors import InvalidInputError
from gausslite.domain.gaussians import Gaussians
home = gl.open_sequence("sim:home?size=32x24")
frame, empty = home.frame(0, (32, 24)), Gaussians.empty()
messages = {}
for call in json.load(sys.stdin):
    try:
        eval(call)
        messages[call] = "no error"
    except InvalidInputError as error:
        messages[call] = str(error)
    except Exception as error:
        messages[call] = repr(error)
json.dump(messages, sys.stdout)
"""


@pytest.fixture(scope="module")
def messages() -> dict[str, str]:
    """Return the message of each call, from a process without the type checks of the tests."""
    pytest.importorskip("embreex", reason="simulated homes need the extra sim")
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM], input=json.dumps(list(WRONG)), capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    result: dict[str, str] = json.loads(done.stdout)
    return result


@pytest.mark.parametrize("call", WRONG)
def test_a_wrong_argument_is_one_clear_error(messages: dict[str, str], call: str) -> None:
    assert re.search(WRONG[call], messages[call]), messages[call]
