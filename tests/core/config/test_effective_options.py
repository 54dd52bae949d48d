"""Options of the real programs: their help, their printed configuration, switches, and known names."""

from __future__ import annotations

import argparse
import importlib
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

import gausslite_agent.settings as agent
import gausslite_fusion_server.settings as fusion_server
import gausslite_parser.settings as parser_service
from gausslite.config.known_options import KNOWN_OPTIONS
from gausslite.config.layers import parse_options
from gausslite.config.option_table import OptionTable
from gausslite.domain.errors import InvalidInputError
from gausslite.process.messages import print_message

SERVICES = (agent, fusion_server, parser_service)


def command(name: str) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog=name)
    module = "gausslite_bench.cli.main" if name == "bench" else f"gausslite.cli.{name}_command"
    importlib.import_module(module).configure(parser)
    return parser


def parsers() -> Iterator[argparse.ArgumentParser]:
    """Yield the parser of every configurable program and benchmark."""
    yield from (service.build_parser() for service in SERVICES)
    yield from (command(name) for name in ("map", "demo", "eval"))
    for action in command("bench")._actions:
        if isinstance(action, argparse._SubParsersAction):
            yield from action.choices.values()


def printed(parser: argparse.ArgumentParser, capsys: pytest.CaptureFixture[str], *flags: str) -> str:
    with pytest.raises(SystemExit) as ended:
        parse_options(parser, [*flags, "--print-config"], {}, warn=print_message)
    assert ended.value.code == 0
    return capsys.readouterr().out


def test_the_help_states_no_raw_defaults() -> None:
    for parser in parsers():
        text = " ".join(parser.format_help().split())
        assert not re.findall(r"\(default: (?:None|False|True|\[\]|\(\))?\)|\) \(default:", text), parser.prog


def test_the_help_of_the_fusion_server_names_its_maintenance_commands() -> None:
    text = " ".join(fusion_server.build_parser().format_help().split())
    assert "file of a store: backup, restore, verify, compact." in text


def test_the_list_of_known_options_is_complete() -> None:
    tables = [OptionTable.of(parser) for parser in parsers()]
    assert {table.key(dest) for table in tables for dest in table.actions} == KNOWN_OPTIONS


def test_options_of_another_program_give_no_warning(capsys: pytest.CaptureFixture[str]) -> None:
    parse_options(
        parser_service.build_parser(),
        [],
        {"GAUSSLITE_MAX_GAUSSIANS": "5", "GAUSSLITE_LISTEN": "[::1]:1"},
        warn=print_message,
    )
    assert capsys.readouterr().err == ""
    parse_options(parser_service.build_parser(), [], {"GAUSSLITE_ZZZ\x1b": "5"}, warn=print_message)
    assert capsys.readouterr().err == "gausslite-parser: GAUSSLITE_ZZZ\\x1b is not an option\n"


def test_every_boolean_option_can_be_switched_off(tmp_path: Path) -> None:
    file = tmp_path / "agent.toml"
    file.write_text("\ufeffstrict = true\nhandover = true\n", encoding="utf-8")
    config = ["--config", str(file)]
    assert parse_options(agent.build_parser(), config, {}, warn=print_message).strict
    assert not parse_options(agent.build_parser(), [*config, "--no-strict"], {}, warn=print_message).strict
    assert not parse_options(agent.build_parser(), config, {"GAUSSLITE_STRICT": "false"}, warn=print_message).strict
    for parser in parsers():
        plain = [each.dest for each in parser._actions if isinstance(each, argparse._StoreTrueAction)]
        assert set(plain) <= {"print_config"}, parser.prog


@pytest.mark.parametrize(
    ("flags", "lines"),
    [
        ((), ['# policy = "uniform"', "# iterations = 8", 'pose-prior = "auto"']),
        (("--task", "Find the mug"), ['# policy = "task"', "# iterations = 8"]),
        (("--rate", "4", "--policy", "paper"), ['policy = "paper"', "rate = 4.0"]),
    ],
)
def test_the_printed_configuration_of_map_states_defaults_that_depend_on_other_options(
    flags: tuple[str, ...], lines: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    text = printed(command("map"), capsys, *flags)
    assert set(lines) <= set(text.splitlines())
    assert ("iterations = " in text.replace("min-iterations", "")) == ("--rate" not in flags)
    assert re.search(r"^# threads = \d+$", text, re.MULTILINE)


def test_the_printed_configuration_of_the_agent_is_read_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = printed(agent.build_parser(), capsys)
    assert 'pose-prior = "none"\n' in text
    file = tmp_path / "agent.toml"
    file.write_text(text)
    assert printed(agent.build_parser(), capsys, "--config", str(file)) == text
    file.write_text(text.replace("# ", "").split("\n", 1)[1].replace("defaults that", "#"))
    assert agent.parse_arguments(["--config", str(file)]).mission.iterations == 8


def test_a_printed_configuration_hides_the_password_of_a_url(capsys: pytest.CaptureFixture[str]) -> None:
    text = printed(parser_service.build_parser(), capsys, "--llm-url", "http://user:secret@host:8000/v1")
    assert 'llm-url = "http://user:***@host:8000/v1"' in text


@pytest.mark.parametrize(
    "url", ["postgresql://fusion:se/cr@et@db/team", "postgresql://fusion@db/team?sslmode=require&password=se/cr@et"]
)
def test_a_printed_configuration_hides_the_password_of_a_database(url: str, capsys: pytest.CaptureFixture[str]) -> None:
    text = printed(fusion_server.build_parser(), capsys, "--store", url)
    assert "se/cr" not in text
    assert "et@db" not in text
    assert "fusion" in text
    assert "db/team" in text


@pytest.mark.parametrize(
    ("flags", "named"),
    [(["--rate", "-1"], "--rate: expected"), (["--seed", "-1"], "--seed: expected 0"), (["--threads", "0"], "threads")],
)
def test_a_flag_outside_its_bounds_is_named(flags: list[str], named: str) -> None:
    with pytest.raises(InvalidInputError, match=named):
        parse_options(agent.build_parser(), flags, {}, warn=print_message)
