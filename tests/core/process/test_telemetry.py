"""Telemetry of libraries is off at the moment of their import, and the site loads nothing from other servers."""

import ast
import json
import subprocess
import sys
from pathlib import Path

import yaml

ROOT = Path(__file__).resolve().parents[3]
WITH_TELEMETRY = ("onnxruntime", "onnxruntime_genai")
# a finder sees each import before the library is loaded
SCRIPT = """
import os, sys
class Watch:
    def find_spec(self, name, path=None, target=None):
        if name in ("onnxruntime", "onnxruntime_genai"):
            print(name, os.environ.get("ORT_DISABLE_TELEMETRY"), file=sys.stderr)
            raise ImportError(name)
sys.meta_path.insert(0, Watch())
from pathlib import Path
from gausslite.domain.errors import InvalidInputError
from gausslite_detectors.model_file import open_model
from gausslite_language.models.onnx import OnnxLanguageModel
for attempt in (lambda: open_model(Path(sys.argv[1])), lambda: OnnxLanguageModel(Path(sys.argv[2]))):
    try:
        attempt()
    except (ImportError, InvalidInputError):
        pass
"""


def test_telemetry_is_off_when_a_library_is_imported(tmp_path: Path) -> None:
    from tiny_yolo import write_tiny_yolo

    model = write_tiny_yolo(tmp_path / "yolo.onnx", ["mug"], [(32, 32, 20, 20, 0, 0.9)])
    (tmp_path / "genai_config.json").write_text(json.dumps({"model": {"context_length": 128}}))
    command = [sys.executable, "-c", SCRIPT, str(model), str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    assert set(done.stderr.splitlines()) == {f"{name} 1" for name in WITH_TELEMETRY}


def test_modules_that_import_such_a_library_switch_its_telemetry_off() -> None:
    importing = []
    for folder in ("src", "services"):
        for path in sorted((ROOT / folder).rglob("*.py")):
            text = path.read_text()
            if "onnxruntime" not in text:
                continue
            names = {
                alias.name.partition(".")[0]
                for node in ast.walk(ast.parse(text))
                if isinstance(node, ast.Import)
                for alias in node.names
            }
            if names & set(WITH_TELEMETRY):
                importing.append(path.name)
                assert "disable_telemetry()" in text, path
    assert importing


def test_the_site_asks_no_other_server() -> None:
    class Loader(yaml.SafeLoader):
        """Reads the file without the functions that its tags name."""

    Loader.add_multi_constructor("tag:yaml.org,2002:python/", lambda *_: None)
    settings = yaml.load((ROOT / "mkdocs.yml").read_text(), Loader)
    assert settings["theme"]["font"] is False
    assert "analytics" not in settings["extra"]
