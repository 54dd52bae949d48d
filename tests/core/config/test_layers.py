"""Flags override variables, those override the file; wrong values end in one line that says what would be right."""

import tomllib
from argparse import Namespace
from collections.abc import Mapping
from dataclasses import MISSING, dataclass
from enum import StrEnum
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gausslite.config.command_parser import CommandParser
from gausslite.config.option import build, check_options, option, plain_options
from gausslite.config.plain_values import to_toml
from gausslite.config.program import Program, parse_options
from gausslite.domain.errors import InvalidInputError


class Speed(StrEnum):
    SLOW = "slow"
    FAST = "fast"


@dataclass(frozen=True, slots=True)
class Budget:
    """Options with bounds and an alternative."""

    limit: int = option(10, "limit", key="max-items", low=1)
    steps: int | None = option(None, "steps", low=0, excludes="rate")
    rate_hz: float | None = option(None, "rate", key="rate", metavar="HZ", unit="Hz", low=0.01, high=1000)

    def __post_init__(self) -> None:
        check_options(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """One option of every kind."""

    source: str = option(MISSING, "source", metavar="SOURCE")
    out: Path = option(MISSING, "folder", metavar="DIR")
    budget: Budget
    names: tuple[str, ...] = option((), "names", metavar="A,B")
    balls: tuple[str, ...] = option((), "balls", key="ball", repeats=True)
    verbose: bool = option(False, "verbose")
    fit: bool | None = option(None, "fit", key="fit-views")
    speed: Speed = option(Speed.SLOW, "speed")
    colour: str = option("red", "colour", choices=("red", "blue"), needs="rate")


def parser_of_settings() -> CommandParser:
    parser = CommandParser(prog="mapper")
    Program.of(Settings, flags="out max-items rate steps names ball verbose colour", positional="source").add_to(parser)
    return parser


def parse(*flags: str, file: Path | None = None, environment: Mapping[str, str] | None = None) -> Namespace:
    config = () if file is None else ("--config", str(file))
    return parse_options(parser_of_settings(), [*flags, *config], environment or {}, warn=print)


def written(folder: Path, text: str) -> Path:
    path = folder / "mapper.toml"
    path.write_bytes(text.encode(errors="surrogateescape"))
    return path


def test_each_layer_overrides_the_one_below(tmp_path: Path) -> None:
    file = written(tmp_path, '\ufeffsource = "home"\nout = "maps"\nmax-items = 1\nverbose = true\nspeed = "fast"\n')
    options = parse("--max-items", "3", file=file, environment={"GAUSSLITE_MAX_ITEMS": "2", "GAUSSLITE_VERBOSE": "no"})
    assert (options.source, options.out, options.max_items) == ("home", Path("maps"), 3)
    assert (options.verbose, options.speed) == (False, Speed.FAST)
    assert parse("office", "--out", "x", file=file).source == "office"
    assert parse(environment={"GAUSSLITE_CONFIG": str(file)}).max_items == 1


def test_a_positional_option_may_follow_flags() -> None:
    assert parse("--out=x", "home").source == "home"
    assert parse("--set", "verbose=true", "home", "--out=x").verbose


def test_lists_are_arrays_or_texts_and_a_repeated_flag_replaces_the_list_of_the_file(tmp_path: Path) -> None:
    file = written(tmp_path, 'names = ["mug", "chair"]\nball = ["0,1", "2"]\n')
    options = parse("home", "--out=x", file=file)
    assert (options.names, options.ball) == (("mug", "chair"), ("0,1", "2"))
    assert parse("home", "--out=x", "--ball=c", "--ball=d", "--names=a, b", file=file).ball == ("c", "d")
    assert parse("home", "--out=x", "--set=ball=c", "--set=ball=d", file=file).ball == ("c", "d")
    assert parse("home", "--out=x", environment={"GAUSSLITE_BALL": "e\nf"}, file=file).ball == ("e", "f")


@pytest.mark.parametrize(
    ("flags", "environment", "expected"),
    [
        ((), {}, (5, None)),
        (("--rate", "4"), {}, (None, 4.0)),
        ((), {"GAUSSLITE_RATE": "2"}, (None, 2.0)),
        (("--set", "steps=7"), {"GAUSSLITE_RATE": "2"}, (7, None)),
    ],
)
def test_an_option_replaces_the_one_that_it_excludes_in_lower_layers(
    tmp_path: Path, flags: tuple[str, ...], environment: Mapping[str, str], expected: tuple[int | None, float | None]
) -> None:
    options = parse("home", "--out=x", *flags, environment=environment, file=written(tmp_path, "steps = 5\n"))
    assert (options.steps, options.rate) == expected


WRONG_FILES = {
    "max-itms = 5": "max-itms: unknown option; did you mean max-items?",
    "max_items = 5": "max_items: unknown option; did you mean max-items?",
    "config = 'x'": "config: unknown option",
    "[mapping]\nrate = 1": "[mapping]: tables are not supported; write NAME = VALUE at the top level",
    "speed = ['slow', 'fast']": "speed: expected text, got ['slow', 'fast']",
    "rate = -1": "rate: expected 0.01 to 1000 Hz, got -1",
    "max-items = 0": "max-items: expected at least 1, got 0",
    "rate = nan": "rate: expected 0.01 to 1000 Hz, got nan",
    "max-items = '5'": "max-items: expected a whole number, got '5'",
    "max-items = 5.5": "max-items: expected a whole number, got 5.5",
    "max-items = true": "max-items: expected a whole number, got True",
    "rate = [4]": "rate: expected a number, got [4]",
    "out = 5": "out: expected text, got 5",
    "out = ''": "out: expected a path, got an empty text",
    "verbose = 1": "verbose: expected true or false, got 1",
    "names = 5": "names: expected a list of texts, got 5",
    "speed = 'idle'": "speed: expected one of slow, fast, got 'idle'",
    "colour = 'green'": "colour: expected one of red, blue, got 'green'",
    "colour = 'blue'": "colour: has an effect only with --rate HZ; give both, or omit colour",
    "steps = 1\nrate = 2": "expected only one of rate and steps, got both",
    "= 5": "expected TOML: ",
    "names = '\udc80'": "expected UTF-8 text, got another encoding (byte 9); save the file as UTF-8",
}
WRONG_ARGUMENTS = {
    ("--set", "verbose"): "--set verbose: expected KEY=VALUE",
    ("--set", "ratte=4"): "--set ratte: unknown option; did you mean rate?",
    ("--rate=4", "--steps=1"): "expected only one of --rate and --steps, got both",
    ("--max-items=many",): "--max-items: expected a whole number, got 'many'",
    ("--set", "verbose=maybe"): "--set verbose: expected true or false, got 'maybe'",
}
WRONG_FLAGS = {
    ("--no-verbose",): "--no-verbose: write --set verbose=false",
    ("--max-item", "5"): "unrecognized arguments: --max-item 5; did you mean --max-items?",
    ("--sped=fast",): "unrecognized arguments: --sped=fast; did you mean --speed?",
    ("more",): "unrecognized arguments: more; arguments stand before the options",
}


@pytest.mark.parametrize(("text", "message"), WRONG_FILES.items())
def test_a_wrong_file_is_one_line_that_names_file_and_key(tmp_path: Path, text: str, message: str) -> None:
    path = written(tmp_path, text)
    with pytest.raises(InvalidInputError) as error:
        parse("home", *(() if text.startswith("out") else ("--out=x",)), file=path)
    assert message in str(error.value)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(("arguments", "message"), WRONG_ARGUMENTS.items())
def test_a_wrong_value_is_one_line_that_names_the_flag(arguments: tuple[str, ...], message: str) -> None:
    with pytest.raises(InvalidInputError) as error:
        parse("home", "--out=x", *arguments)
    assert str(error.value) == message


@pytest.mark.parametrize(("arguments", "message"), WRONG_FLAGS.items())
def test_a_wrong_flag_is_one_line_that_names_its_successor(
    arguments: tuple[str, ...], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        parse("home", "--out=x", *arguments)
    assert ended.value.code == 2
    [line] = capsys.readouterr().err.splitlines()
    assert line.startswith(f"mapper: {message}")
    assert line.endswith("; see `mapper --help`")


def test_missing_options_are_named(capsys: pytest.CaptureFixture[str]) -> None:
    pytest.raises(SystemExit, parse)
    assert capsys.readouterr().err.startswith("mapper: the following arguments are required: SOURCE, --out; see")


@pytest.mark.parametrize("path", ["missing.toml", "."])
def test_a_missing_file_is_reported(tmp_path: Path, path: str) -> None:
    with pytest.raises(InvalidInputError, match=r"--config .*: expected a TOML file"):
        parse("home", "--out=x", file=tmp_path / path)


def test_a_misspelt_variable_is_reported_without_its_value(capsys: pytest.CaptureFixture[str]) -> None:
    variables = {"GAUSSLITE_MAX_ITMS": "secret", "GAUSSLITE_SIMD": "avx2", "GAUSSLITE_RATE": "", "MAX_ITMS": "5"}
    assert parse("home", "--out=x", environment=variables).max_items == 10
    [warning] = capsys.readouterr().out.splitlines()
    assert warning == "mapper: GAUSSLITE_MAX_ITMS is not an option; did you mean GAUSSLITE_MAX_ITEMS?"


def test_settings_are_built_from_options_and_written_as_options() -> None:
    options = parse("home", "--out=x", "--rate=2", "--names=a,b", "--set=speed=fast")
    settings = build(Settings, options)
    assert settings.budget == Budget(rate_hz=2.0)
    assert plain_options(settings) == {
        "source": "home",
        "out": "x",
        "max-items": 10,
        "steps": None,
        "rate": 2.0,
        "names": ["a", "b"],
        "ball": [],
        "verbose": False,
        "fit-views": None,
        "speed": "fast",
        "colour": "red",
    }


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"limit": 0}, "limit: expected at least 1, got 0"),
        ({"limit": 1.5}, "limit: expected a whole number, got float 1.5"),
        ({"rate_hz": "4"}, "rate_hz: expected a number, got str '4'"),
        ({"rate_hz": float("nan")}, "rate_hz: expected 0.01 to 1000 Hz, got nan"),
    ],
)
def test_settings_of_the_python_api_have_the_same_bounds(values: dict[str, float], message: str) -> None:
    with pytest.raises(InvalidInputError) as error:
        Budget(**values)  # type: ignore[arg-type]
    assert str(error.value) == message


TEXTS = st.text(st.characters(exclude_categories=["Cs"]))


@given(st.one_of(TEXTS, st.booleans(), st.integers(-(2**63), 2**63 - 1), st.floats(allow_nan=False), st.lists(TEXTS)))
def test_tomllib_reads_what_to_toml_writes(value: str | bool | int | float | list[str]) -> None:
    assert tomllib.loads(to_toml({"a-key": value, "unset": None})) == {"a-key": value}
