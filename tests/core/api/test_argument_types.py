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
}
PROGRAM = """
import dataclasses, json, sys
import gausslite as gl
from gausslite.domain.errors import InvalidInputError
home = gl.open_sequence("sim:home?size=32x24")
frame = home.frame(0, (32, 24))
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
