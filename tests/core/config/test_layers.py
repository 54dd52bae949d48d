"""Flags override the environment, which overrides the file; what --print-config writes, --config reads."""

from __future__ import annotations

import argparse
import tomllib
from collections.abc import Mapping
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gausslite.cli.main import main
from gausslite.config.command_parser import CommandParser
from gausslite.config.environment import without_options
from gausslite.config.layers import parse_options
from gausslite.config.mapping_options import add_budget, add_policy
from gausslite.config.task_parser_options import add_backend
from gausslite.config.toml_text import to_toml
from gausslite.config.values import read_names
from gausslite.domain.errors import InvalidInputError
from gausslite.process.messages import print_message


def program() -> argparse.ArgumentParser:
    """Return a parser with one option of every kind."""
    parser = CommandParser(prog="mapper")
    parser.add_argument("source", metavar="SOURCE")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--names", type=read_names, default=())
    parser.add_argument("--ball", action="append", default=[])
    parser.add_argument("--verbose", action="store_true")
    parser.add_argument("--fit-views", action=argparse.BooleanOptionalAction)
    parser.add_argument("--kind", choices=["slow", "fast"], default="slow")
    add_policy(parser)
    add_budget(parser)
    add_backend(parser)
    return parser


def parse(*flags: str, file: Path | None = None, environment: Mapping[str, str] | None = None) -> argparse.Namespace:
    config = () if file is None else ("--config", str(file))
    return parse_options(program(), [*flags, *config], environment or {}, warn=print_message)


def written(folder: Path, text: str) -> Path:
    path = folder / "mapper.toml"
    path.write_text(text)
    return path


def test_each_layer_overrides_the_one_below(tmp_path: Path) -> None:
    file = written(tmp_path, 'source = "home"\nout = "maps"\nmax-gaussians = 10\nseed = 1\nthreads = 1\n')
    environment = {"GAUSSLITE_SEED": "2", "GAUSSLITE_THREADS": "2"}
    options = parse("--threads", "3", file=file, environment=environment)
    assert (options.source, options.out) == ("home", Path("maps"))
    assert (options.max_gaussians, options.seed, options.threads) == (10, 2, 3)


def test_a_positional_argument_and_a_required_flag_override_the_file(tmp_path: Path) -> None:
    file = written(tmp_path, 'source = "home"\nout = "maps"\n')
    options = parse("office", "--out", "x", file=file)
    assert (options.source, options.out) == ("office", Path("x"))


def test_a_repeated_flag_replaces_the_list_of_the_file(tmp_path: Path) -> None:
    file = written(tmp_path, 'ball = ["a", "b"]\n')
    assert parse("home", "--out=x", file=file).ball == ["a", "b"]
    assert parse("home", "--out=x", "--ball=c", file=file).ball == ["c"]
    assert parse("home", "--out=x", environment={"GAUSSLITE_BALL": "d\ne"}, file=file).ball == ["d", "e"]


def test_arrays_are_comma_lists_and_switches_are_booleans(tmp_path: Path) -> None:
    file = written(tmp_path, 'names = ["mug", "chair"]\nverbose = true\nfit-views = false\n')
    options = parse("home", "--out=x", file=file)
    assert (options.names, options.verbose, options.fit_views) == (("mug", "chair"), True, False)
    assert parse("home", "--out=x", "--fit-views", file=file).fit_views is True
    assert parse("home", "--out=x", environment={"GAUSSLITE_VERBOSE": "off"}, file=file).verbose is False


@pytest.mark.parametrize(
    ("flags", "environment", "expected"),
    [
        ((), {}, (5, None)),
        (("--rate", "4"), {}, (None, 4.0)),
        ((), {"GAUSSLITE_RATE": "2"}, (None, 2.0)),
        (("--iterations", "7"), {"GAUSSLITE_RATE": "2"}, (7, None)),
    ],
)
def test_an_exclusive_option_replaces_its_rival_in_lower_layers(
    tmp_path: Path,
    flags: tuple[str, ...],
    environment: Mapping[str, str],
    expected: tuple[int | None, float | None],
) -> None:
    options = parse("home", "--out=x", *flags, environment=environment, file=written(tmp_path, "iterations = 5\n"))
    assert (options.iterations, options.rate) == expected


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("max-gausians = 5", "unknown option 'max-gausians'; did you mean max-gaussians\\?"),
        ("max_gaussians = 5", "unknown option 'max_gaussians'; did you mean max-gaussians\\?"),
        ("config = 'x'", "unknown option 'config'$"),
        ("[mapping]\nrate = 1", r"\[mapping\]: tables are not supported; write NAME = VALUE at the top level"),
        ("kind = ['slow', 'fast']", r"kind: expected text, got \['slow', 'fast'\]"),
        ("rate = -1", "rate: expected 0.01 to 1000, got -1$"),
        ("seed = 4294967296", "seed: expected 0 to 4294967295, got 4294967296"),
        ("threads = 0", "threads: expected 1 to 256, got 0"),
        ("max-gaussians = 0", "max-gaussians: expected at least 1, got 0"),
        ("deadline-slack = nan", "deadline-slack: expected 0 to 1, got nan"),
        ("max-gaussians = '5'", "max-gaussians: expected a whole number, got '5'"),
        ("max-gaussians = 5.5", "max-gaussians: expected a whole number, got 5.5"),
        ("max-gaussians = true", "max-gaussians: expected a whole number, got True"),
        ("rate = [4]", r"rate: expected a number, got \[4\]"),
        ("out = 5", "out: expected text, got 5"),
        ("verbose = 1", "verbose: expected true or false, got 1"),
        ("kind = 'idle'", "kind: expected one of slow, fast, got 'idle'"),
        ("skip-stages = 'x'", "skip-stages: expected names among publishing, seeding, got 'x'"),
        ("[source]\nx = 1", "tables are not supported"),
        ("iterations = 1\nrate = 2", "expected only one of iterations and rate, got both"),
        ("= 5", "expected TOML"),
        ("seed = '\udc80'", r"expected UTF-8 text, got another encoding \(byte 8\)"),
    ],
)
def test_a_wrong_file_is_one_line_that_names_file_and_key(tmp_path: Path, text: str, named: str) -> None:
    path = tmp_path / "wrong.toml"
    path.write_bytes(text.encode(errors="surrogateescape"))
    with pytest.raises(InvalidInputError, match=named) as error:
        parse("home", "--out=x", file=path)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("path", ["missing.toml", "."])
def test_a_missing_file_is_reported(tmp_path: Path, path: str) -> None:
    with pytest.raises(InvalidInputError, match=r"--config .*: expected a TOML file"):
        parse("home", "--out=x", file=tmp_path / path)


@pytest.mark.parametrize(
    ("name", "value", "named"),
    [
        ("GAUSSLITE_SEED", "many", "GAUSSLITE_SEED: expected a whole number, got 'many'"),
        ("GAUSSLITE_VERBOSE", "maybe", "GAUSSLITE_VERBOSE: expected true or false, got 'maybe'"),
        ("GAUSSLITE_KIND", "idle", "GAUSSLITE_KIND: expected one of slow, fast"),
    ],
)
def test_a_wrong_variable_is_named(name: str, value: str, named: str) -> None:
    with pytest.raises(InvalidInputError, match=named):
        parse("home", "--out=x", environment={name: value})


def test_unknown_variables_are_warnings_without_their_values(capsys: pytest.CaptureFixture[str]) -> None:
    others = {"GAUSSLITE_SIMD": "avx2", "GAUSSLITE_LLM_API_KEY": "secret", "GAUSSLITE_KEY": "secret", "HOME": "/"}
    variables = {"GAUSSLITE_MAX_GAUSIANS": "secret", "GAUSSLITE_SEED": "", **others}
    assert parse("home", "--out=x", "--llm-key-variable=GAUSSLITE_KEY", environment=variables).seed == 0
    [warning] = capsys.readouterr().err.splitlines()
    assert warning == "mapper: GAUSSLITE_MAX_GAUSIANS is not an option; did you mean GAUSSLITE_MAX_GAUSSIANS?"


@pytest.mark.parametrize(
    ("variable", "meant"), [("GAUSSLITE_SIMDD", "GAUSSLITE_SIMD"), ("GAUSSLITE_RECORDING", "GAUSSLITE_RECORDINGS")]
)
def test_the_nearest_of_all_known_variables_is_suggested(
    variable: str, meant: str, capsys: pytest.CaptureFixture[str]
) -> None:
    parse("home", "--out=x", environment={variable: "x"})
    assert capsys.readouterr().err == f"mapper: {variable} is not an option; did you mean {meant}?\n"


def test_a_command_without_configuration_names_a_misspelt_variable(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("GAUSSLITE_LLM_API_KEI", "secret")
    assert main(["parse", "Find the mug"]) == 0
    expected = "gausslite: GAUSSLITE_LLM_API_KEI is not an option; did you mean GAUSSLITE_LLM_API_KEY?\n"
    assert capsys.readouterr().err == expected


def test_the_environment_can_name_the_file(tmp_path: Path) -> None:
    file = written(tmp_path, "seed = 4\n")
    assert parse("home", "--out=x", environment={"GAUSSLITE_CONFIG": str(file)}).seed == 4


def test_a_preset_is_below_every_other_layer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "gausslite.config.layers.PRESETS", {"paper": {"policy": "uniform", "max-gaussians": 77, "x": 1}}
    )
    options = parse("home", "--out=x", "--preset=paper")
    assert (options.policy, options.max_gaussians) == ("uniform", 77)
    assert parse("home", "--out=x", "--preset=paper", "--max-gaussians=5").max_gaussians == 5
    file = written(tmp_path, 'preset = "paper"\npolicy = "task"\n')
    options = parse("home", "--out=x", file=file)
    assert (options.policy, options.max_gaussians) == ("task", 77)


@pytest.mark.parametrize("flags", [(), ("home",), ("--out=x",), ("home", "--out=x", "--seed=x"), ("home", "--bad")])
def test_argparse_still_reports_wrong_flags(flags: tuple[str, ...], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        parse(*flags)
    assert ended.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("mapper: ")
    assert line.endswith("; see `mapper --help`")


def test_help_shows_the_real_defaults(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        parse("--help")
    assert ended.value.code == 0
    shown = capsys.readouterr().out
    assert "150000" in shown
    assert "SUPPRESS" not in shown
    assert "--print-config" in shown


def printed(flags: tuple[str, ...], capsys: pytest.CaptureFixture[str], environment: Mapping[str, str]) -> str:
    with pytest.raises(SystemExit) as ended:
        parse(*flags, "--print-config", environment=environment)
    assert ended.value.code == 0
    return capsys.readouterr().out


def test_a_printed_configuration_gives_the_same_options(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    flags = (
        "home",
        "--out",
        'a "b"\\ü\n',
        "--names=mug,chair",
        "--ball=0,0",
        "--ball=1",
        "--verbose",
        "--no-fit-views",
    )
    flags = (*flags, "--rate", "4", "--skip-stages=", "--pose-prior=0.01,0.5", "--disable=sb,mvo")
    environment = {"GAUSSLITE_MAX_GAUSSIANS": "123"}
    text = printed(flags, capsys, environment)
    again = parse(file=written(tmp_path, text))
    expected = parse(*flags, environment=environment)
    assert {**vars(again), "config": None} == vars(expected)
    assert printed(("--config", str(tmp_path / "mapper.toml")), capsys, {}) == text


def test_a_printed_configuration_needs_no_required_option(capsys: pytest.CaptureFixture[str]) -> None:
    values = tomllib.loads(printed((), capsys, {}))
    assert values["max-gaussians"] == 150_000
    assert "source" not in values
    assert "out" not in values


def test_a_printed_configuration_has_no_secrets(capsys: pytest.CaptureFixture[str]) -> None:
    environment = {"GAUSSLITE_LLM_API_KEY": "secret", "MY_KEY": "secret"}
    text = printed(("--llm-key-variable", "MY_KEY"), capsys, environment)
    assert "secret" not in text
    assert 'llm-key-variable = "MY_KEY"' in text


def test_sub_commands_are_configured_alike() -> None:
    parser = argparse.ArgumentParser(prog="bench")
    commands = parser.add_subparsers(required=True)
    commands.add_parser("loop").add_argument("--seed", type=int, default=0)
    assert parse_options(parser, ["loop"], {"GAUSSLITE_SEED": "3"}, warn=print_message).seed == 3
    with pytest.raises(SystemExit):
        parse_options(parser, [], {}, warn=print_message)


def test_a_child_process_inherits_no_option_variables() -> None:
    environment = {"PATH": "/bin", "GAUSSLITE_OUT": "x", "GAUSSLITE_SIMD": "avx2"}
    assert without_options(environment) == {"PATH": "/bin", "GAUSSLITE_SIMD": "avx2"}


TEXTS = st.text(st.characters(exclude_categories=["Cs"]))


@settings(max_examples=200, deadline=None)
@given(st.one_of(TEXTS, st.booleans(), st.integers(-(2**63), 2**63 - 1), st.floats(allow_nan=False), st.lists(TEXTS)))
def test_tomllib_reads_what_to_toml_writes(value: str | bool | int | float | list[str]) -> None:
    assert tomllib.loads(to_toml({"a-key": value, "unset": None})) == {"a-key": value}
