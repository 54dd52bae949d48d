"""`gausslite doctor`: findings agree with the machine, faults are errors with exit code 1, and no socket connects."""

import json
import socket
import subprocess
import sys
from collections.abc import Callable
from importlib.metadata import PathDistribution, metadata, version
from pathlib import Path

import pytest
from tiny_yolo import write_tiny_yolo

from gausslite.cli.main import main
from gausslite.render.choose import choose_rasterizer
from gausslite.render.cpu import choose_simd
from gausslite.wire.channel import AGENT_ADDRESS, FUSION_ADDRESS, PARSER_ADDRESS
from gausslite_demo import doctor_command

Doctor = Callable[..., tuple[int, dict[str, dict[str, str]]]]


@pytest.fixture
def doctor(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Doctor:
    """Return a function that runs the command in an empty folder: its exit code, and its checks by name."""
    monkeypatch.chdir(tmp_path)

    def run(*arguments: str) -> tuple[int, dict[str, dict[str, str]]]:
        code = main(["doctor", "--json", *arguments])
        printed = capfd.readouterr()
        assert printed.err == ""
        report = json.loads(printed.out)
        assert report["ok"] is (code == 0)
        return code, {check["name"]: check for check in report["checks"]}

    return run


def test_a_working_machine_has_no_error_and_the_findings_are_true(tmp_path: Path, doctor: Doctor) -> None:
    code, checks = doctor()
    assert code == 0
    assert {check["status"] for check in checks.values()} <= {"ok", "warning"}
    assert all(check["advice"] for check in checks.values() if check["status"] != "ok")
    assert f"they use {choose_simd(None)}" in checks["cpu"]["finding"]
    assert checks["rasterizer"]["finding"].startswith(f"backend {choose_rasterizer('auto').name}, because ")
    assert version("gausslite") in checks["package"]["finding"]
    assert [name for name in checks if name.startswith("model")] == ["models"]
    assert "RFDETRSegNano().export(output_dir='.')" in checks["models"]["advice"]
    extras = {name.removeprefix("extra ") for name in checks if name.startswith("extra ")}
    absent = checks["extras"]["finding"].removeprefix("not installed: ").split(", ") if "extras" in checks else []
    assert extras.union(absent) == set(metadata("gausslite").get_all("Provides-Extra") or ())
    assert list(tmp_path.iterdir()) == []


def test_the_text_has_one_line_for_each_check(doctor: Doctor, capfd: pytest.CaptureFixture[str]) -> None:
    _, checks = doctor()
    assert main(["doctor"]) == 0
    lines = capfd.readouterr().out.splitlines()
    assert len(lines) == len(checks)
    assert {line.split()[0] for line in lines} <= {"ok", "warning"}


def test_an_unusable_instruction_set_is_an_error(doctor: Doctor, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GAUSSLITE_SIMD", "mmx")
    code, checks = doctor()
    assert code == 1
    assert checks["cpu"]["status"] == checks["rasterizer"]["status"] == "error"
    assert "GAUSSLITE_SIMD" in checks["cpu"]["finding"]


def test_the_portable_kernels_are_a_warning(doctor: Doctor, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GAUSSLITE_SIMD", "portable")
    code, checks = doctor()
    assert code == 0
    assert checks["cpu"]["status"] == "warning"


def test_a_complete_model_passes_and_a_truncated_one_is_an_error(tmp_path: Path, doctor: Doctor) -> None:
    model = tmp_path / "yolo11n-seg.onnx"
    write_tiny_yolo(model, ["mug"], [(32, 32, 20, 20, 0, 0.9)])
    code, checks = doctor("--folder", str(tmp_path))
    assert code == 0
    assert "YOLO-seg" in checks["model yolo-seg"]["finding"]
    assert [name for name in checks if name.startswith("model")] == ["model yolo-seg"]

    model.write_bytes(model.read_bytes()[:-10])
    code, checks = doctor("--folder", str(tmp_path))
    assert code == 1
    assert checks["model yolo-seg"]["status"] == "error"


def test_results_cannot_be_written_below_a_file(tmp_path: Path, doctor: Doctor) -> None:
    file = tmp_path / "notes.txt"
    file.write_text("not a folder")
    code, checks = doctor("--out", str(file / "run"))
    assert code == 1
    assert checks["disk"]["status"] == "error"
    assert "--out" in checks["disk"]["advice"]


def test_a_taken_port_is_a_warning() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        check = doctor_command.check_port("gausslite-agent", f"127.0.0.1:{port}")
        assert (check.status, check.name) == ("warning", f"port {port}")
        assert "--listen" in check.advice
    assert doctor_command.check_port("gausslite-agent", f"127.0.0.1:{port}").status == "ok"


def test_the_checked_ports_are_those_that_the_services_take_by_default() -> None:
    from gausslite_agent.settings import parse_arguments as agent_settings
    from gausslite_fusion_server.settings import ServerSettings
    from gausslite_parser.program import parse_arguments as parser_settings

    assert parser_settings([]).listen == PARSER_ADDRESS
    assert ServerSettings().listen == FUSION_ADDRESS
    assert agent_settings([]).listen == AGENT_ADDRESS


@pytest.mark.parametrize(("lead_s", "status"), [(0.01, "ok"), (30.0, "warning"), (-30.0, "warning")])
def test_the_clock_is_compared_with_the_file_system(lead_s: float, status: str) -> None:
    assert doctor_command.check_clock(lead_s).status == status


def test_a_clock_from_before_the_installation_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor_command.time, "time", lambda: 0.0)
    assert doctor_command.check_clock(0.0).status == "error"


def test_no_connection_is_opened(tmp_path: Path) -> None:
    script = (
        "import socket, sys\n"
        "def refuse(*_): raise AssertionError('a socket connects')\n"
        "def watch(event, _): event in ('socket.connect', 'socket.getaddrinfo', 'socket.sendto') and refuse()\n"
        "sys.addaudithook(watch)\n"
        "from gausslite.cli.main import main\n"
        "sys.exit(main(['doctor']))\n"
    )
    done = subprocess.run([sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr


def test_absent_extras_are_one_line_and_repairs_name_packages_of_an_index(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: gausslite\nVersion: 1.0\n"
        "Requires-Dist: numpy\nRequires-Dist: pytest>=10000 ; extra == 'test'\n"
        "Requires-Dist: no-such-package ; extra == 'view'\nRequires-Dist: none-such>=2 ; extra == 'ros'\n"
        "Provides-Extra: view\nProvides-Extra: ros\nProvides-Extra: test\n"
    )
    monkeypatch.setattr(doctor_command, "distribution", lambda _: PathDistribution(tmp_path))
    checks = {check.name: check for check in doctor_command.extra_checks()}
    assert checks.keys() == {"package", "extra test", "extras"}
    assert (checks["package"].status, checks["extra test"].status, checks["extras"].status) == ("ok", "warning", "ok")
    assert checks["extra test"].advice == "Repair it with: pip install 'pytest>=10000'"
    assert checks["extras"].finding == "not installed: ros, view"
