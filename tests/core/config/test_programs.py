"""Properties of every option of every program: key, variable, flag, printed configuration and help agree."""

import re
import tomllib
from argparse import Namespace
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
import pytest

import gausslite_agent.settings as agent
import gausslite_fusion_server.settings as fusion_server
import gausslite_parser.program as parser_service
from gausslite.cli.main import build_parser
from gausslite.config.command_parser import CommandParser
from gausslite.config.option import OptionField
from gausslite.config.program import PROGRAM, Program, choices_of, parse_options, variable_name
from gausslite.domain.errors import InvalidInputError

COMMANDS = ("map", "demo", "eval", "parse")
BENCHMARKS = ("loop", "perception")
TEXTS = {
    "up": "0,1,0",
    "target-at": "0,0,1,0.5",
    "register-depth": "500,500,320,240,0,0,0,0,0,0",
    "camera-correction": "lens=radtan:0.1,0,0,0,0",
    "pose-prior": "0.01,0.5,0.1,0.1",
    "fused-from-agent": "1,2,3,0,0,0,1",
    "disable": "mvo,sb",
    "task-at": "3:Find the mug",
    "parser": "localhost:1",
    "fusion": "localhost:2",
    "health": "localhost:3",
    "peer-address": "localhost:4",
}
"""Values of the options with a text form of their own."""


def program_parsers() -> Iterator[CommandParser]:
    """Yield the parser of every program and command with declared options."""
    yield from (service.build_parser() for service in (agent, fusion_server, parser_service))
    commands = build_parser((*COMMANDS, "bench")).commands
    yield from (commands[name] for name in COMMANDS)
    yield from (commands["bench"].commands[name] for name in BENCHMARKS)


POSITIONAL = {"gausslite eval": ["map.ply"], "gausslite parse": ["Find the mug"]}
"""What these commands need, which is no setting."""
PARSERS = {parser.prog: parser for parser in program_parsers()}
every_program = pytest.mark.parametrize("name", PARSERS)


def program_of(name: str) -> Program:
    program: Program = PARSERS[name].get_default(PROGRAM)
    return program


def read(name: str, *arguments: str, environment: Mapping[str, str] | None = None) -> Namespace:
    return parse_options(PARSERS[name], [*POSITIONAL.get(name, ()), *arguments], environment or {}, warn=print)


def required(program: Program, *, except_for: str = "") -> list[str]:
    """Return arguments for the options that must be set."""
    keys = [*program.positional, *(["out"] if "out" in program.options else [])]
    return [f"--set={key}=x" for key in keys if key in program.options and key != except_for]


def needed(program: Program, declared: OptionField) -> list[str]:
    """Return arguments for the option without which this one has no effect."""
    key, _, values = declared.option.needs.partition("=")
    if key not in program.options:
        return []
    value = values.split("|")[-1] or other_text(program.options[key])
    more = ["--set=llm-model=m", "--set=llm-url=http://x"] if key == "backend" else []
    return [f"--set={key}={value}", *(text for text in more if declared.key not in text)]


def other_text(declared: OptionField) -> str:
    """Return the text of a valid value that is not the default."""
    low, high, kind = declared.option.low, declared.option.high, declared.plain_type
    if declared.key in TEXTS:
        return TEXTS[declared.key]
    if choices := choices_of(declared):
        return next(text for text in reversed(choices) if text != str(declared.default))
    if kind is bool:
        return "false" if declared.default is True else "true"
    if kind in (int, float):
        least = 1 if low is None else low
        return str(kind(least + 6 if high is None or high >= least + 6 else high))
    return "value"


def equal(first: object, second: object) -> bool:
    return (
        bool(np.array_equal(first, second))
        if isinstance(first, np.ndarray) or isinstance(second, np.ndarray)
        else first == second
    )


def printed(name: str, capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    with pytest.raises(SystemExit) as ended:
        read(name, *arguments, "--print-config")
    assert ended.value.code == 0
    return capsys.readouterr().out


@every_program
def test_flag_variable_and_file_give_every_option_the_same_value(name: str, tmp_path: Path) -> None:
    program = program_of(name)
    default = read(name, *required(program))
    for key, declared in program.options.items():
        text = other_text(declared)
        others = [*required(program, except_for=key), *needed(program, declared)]
        file = tmp_path / f"{key}.toml"
        file.write_text(f"{key} = {text if declared.plain_type in (int, float, bool) else repr(text)}\n")
        value = getattr(read(name, *others, f"--set={key}={text}"), declared.dest)
        assert equal(getattr(read(name, *others, f"--config={file}"), declared.dest), value), key
        by_variable = read(name, *others, environment={variable_name(key): text})
        assert equal(getattr(by_variable, declared.dest), value), key
        assert not equal(getattr(default, declared.dest), value), key
        if key in program.flags:
            flag = f"--{key}" if declared.plain_type is bool else f"--{key}={text}"
            assert equal(getattr(read(name, *others, flag), declared.dest), value), key


@every_program
def test_a_printed_configuration_is_read_again(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = program_of(name).options
    changed = [
        f"--set={key}={other_text(declared)}" for key, declared in options.items() if not declared.option.excludes
    ]
    file = tmp_path / "program.toml"
    for arguments in ([], changed):
        text = printed(name, capsys, *arguments)
        file.write_text(text)
        assert printed(name, capsys, f"--config={file}") == text
        assert [key for key in options if not re.search(rf"^(# )?{key} =", text, re.MULTILINE)] == []
        assert tomllib.loads(text).keys() <= options.keys()


@every_program
def test_the_help_has_every_option_and_no_raw_default(name: str) -> None:
    program, text = program_of(name), PARSERS[name].format_help()
    names = [program.options[key].option.metavar if key in program.positional else key for key in program.options]
    assert [option for option in names if option not in re.sub(r"-\s+", "-", text)] == []
    assert not re.findall(r"default: (?:None|False|True|\[\]|\(\))", " ".join(text.split()))


@every_program
def test_every_key_is_also_a_flag_that_the_help_does_not_list(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    program = program_of(name)
    listed = re.findall(r"^  (--[a-z-]+)", PARSERS[name].format_help(), re.MULTILINE)
    for key in program.options.keys() - {*program.flags, *program.positional}:
        assert f"--{key}" not in listed
        default = program.options[key].default
        if isinstance(default, int | float) and not isinstance(default, bool):
            assert printed(name, capsys, f"--{key}={default}") == printed(name, capsys, f"--set={key}={default}")


@every_program
def test_a_number_out_of_range_is_refused(name: str) -> None:
    program = program_of(name)
    for key, declared in program.options.items():
        if declared.option.low is not None:
            with pytest.raises(InvalidInputError, match=rf"^--set {key}: expected .*, got"):
                read(name, *required(program), f"--set={key}={declared.plain_type(declared.option.low - 1)}")
            with pytest.raises(InvalidInputError, match=rf"^{variable_name(key)}: expected .*, got 'nan'|, got nan"):
                read(name, *required(program), environment={variable_name(key): "nan"})


@every_program
def test_an_option_without_what_it_needs_is_refused(name: str) -> None:
    program = program_of(name)
    for key, declared in program.options.items():
        if needed(program, declared):
            needs = declared.option.needs.partition("=")[0]
            with pytest.raises(InvalidInputError, match=rf"^--set {key}: has an effect only with (--)?{needs} "):
                read(name, *required(program), f"--set={key}={other_text(declared)}")


def test_the_printed_configuration_states_defaults_that_depend_on_other_options(
    capsys: pytest.CaptureFixture[str],
) -> None:
    text = printed("gausslite map", capsys)
    assert {'# policy = "uniform"', "# iterations = 8", 'pose-prior = "auto"'} <= set(text.splitlines())
    assert re.search(r"^# threads = \d+$", text, re.MULTILINE)
    assert '# policy = "task"' in printed("gausslite map", capsys, "--task", "Find the mug").splitlines()
    assert "rate = 4.0" in printed("gausslite map", capsys, "--rate", "4").splitlines()


def test_a_printed_configuration_has_no_password(capsys: pytest.CaptureFixture[str]) -> None:
    text = printed("gausslite-parser", capsys, "--llm-url", "http://user:secret@host:8000/v1")
    assert 'llm-url = "http://user:***@host:8000/v1"' in text
