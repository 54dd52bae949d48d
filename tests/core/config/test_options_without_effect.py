"""Options that do nothing without another option are refused before any work."""

from __future__ import annotations

from pathlib import Path

import pytest
from tiny_sequences import write_tum

from gausslite.cli.main import main
from gausslite_agent.program import run as run_agent
from gausslite_parser.program import run as run_parser


@pytest.mark.parametrize(
    ("given", "needed"),
    [
        (("--track-motion", "odometry"), "--poses track"),
        (("--min-iterations", "3"), "--rate HZ"),
        (("--skip-stages", "seeding"), "--rate HZ"),
        (("--deadline-slack", "0.5"), "--rate HZ"),
        (("--segmenter", "depth"), "--detector FILE.onnx"),
        (("--vocabulary", "vocab.txt"), "--detector FILE.onnx"),
    ],
)
@pytest.mark.parametrize("command", ["map", "demo", "agent", "bench loop"])
def test_an_option_without_effect_is_refused(
    command: str, given: tuple[str, ...], needed: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sequence, out = str(write_tum(tmp_path / "room")), ["--out", str(tmp_path / "out")]
    demo_tasks = ["--task-a", "Find the mug", "--task-b", "Find it"]
    arguments = {
        "map": ["map", sequence, *out],
        "demo": ["demo", "--source", sequence, *demo_tasks, *out],
        "agent": ["--source", sequence, "--task", "Find the mug", *out],
        "bench loop": ["bench", "loop", sequence],
    }
    run = run_agent if command == "agent" else main
    assert run([*arguments[command], *given]) == 2
    program = "gausslite-agent" if command == "agent" else "gausslite"
    message = f"{program}: {given[0]}: has an effect only with {needed}; give both, or omit {given[0]}"
    assert capsys.readouterr().err.splitlines() == [message]
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "given", [("--spool", "x.spool"), ("--handover",), ("--keyframes", "4"), ("--team-map", "vote")]
)
def test_an_option_of_the_uplink_is_refused_without_a_fusion_server(
    given: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_agent(["--listen", "127.0.0.1:0", *given]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"{given[0]}: has an effect only with --fusion ADDRESS; give both, or omit {given[0]}" in line


@pytest.mark.parametrize(
    ("given", "needed"),
    [
        (("--llm-model", "phi-3-mini"), "--backend onnx or http"),
        (("--llm-url", "http://localhost:8000/v1"), "--backend http"),
        (("--llm-format", "none"), "--backend http"),
        (("--backend", "onnx", "--llm-model", "phi", "--llm-url", "http://localhost:8000/v1"), "--backend http"),
    ],
)
@pytest.mark.parametrize("command", ["parse", "service"])
def test_an_option_of_a_language_model_is_refused_without_its_backend(
    command: str, given: tuple[str, ...], needed: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert (main(["parse", "Find the mug", *given]) if command == "parse" else run_parser(list(given))) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"{given[-2]}: has an effect only with {needed}" in line
