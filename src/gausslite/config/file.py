"""Read a configuration file: TOML, one key per option, named like its flag (`max-gaussians`)."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

from gausslite.config.nearest import suggestion
from gausslite.config.option_table import Layer, OptionTable, RawValue, accepts_list, number_kind, type_name
from gausslite.domain.errors import InvalidInputError


def read_file(table: OptionTable, path: Path) -> Layer:
    """Return the file's option values. Raises InvalidInputError for unknown keys, wrong types and exclusive options."""
    document = _read_toml(path)
    dests = {table.key(dest): dest for dest in table.actions}
    values: dict[str, RawValue] = {}
    for key, value in document.items():
        if isinstance(value, dict):
            raise InvalidInputError(f"{path}: [{key}]: tables are not supported; write NAME = VALUE at the top level")
        if key not in dests:
            raise InvalidInputError(f"{path}: unknown option {key!r}{suggestion(key, dests)}")
        values[dests[key]] = _raw_value(table, dests[key], value, f"{path}: {key}")
    for dest in values:
        for rival in table.exclusive_with(dest) & values.keys():
            keys = " and ".join(sorted((table.key(dest), table.key(rival))))
            raise InvalidInputError(f"{path}: expected only one of {keys}, got both")
    return Layer(values, {dest: f"{path}: {table.key(dest)}" for dest in values})


def _read_toml(path: Path) -> dict[str, Any]:
    try:
        # some editors begin a file with a byte order mark, which TOML does not allow
        return tomllib.loads(path.read_bytes().decode("utf-8-sig"))
    except OSError as error:
        raise InvalidInputError(f"--config {path}: expected a TOML file: {error.strerror or error}") from None
    except UnicodeDecodeError as error:
        raise InvalidInputError(
            f"--config {path}: expected UTF-8 text, got another encoding (byte {error.start}); save the file as UTF-8"
        ) from None
    except ValueError as error:
        raise InvalidInputError(f"--config {path}: expected TOML: {error}") from None


def _raw_value(table: OptionTable, dest: str, value: object, where: str) -> RawValue:
    if table.is_switch(dest):
        if not isinstance(value, bool):
            raise InvalidInputError(f"{where}: expected true or false, got {value!r}")
        return value
    if table.is_repeatable(dest):
        parts = value if isinstance(value, list) else [value]
        return [_text(table, dest, part, where) for part in parts]
    return _text(table, dest, value, where)


def _text(table: OptionTable, dest: str, value: object, where: str) -> str:
    """Return the text of one value; the elements of an array are joined by commas, as in the flag."""
    action = table.actions[dest]
    kind = number_kind(action)
    numeric = kind is not None
    if isinstance(value, list) and accepts_list(action):
        if all(isinstance(part, str | int | float) and not isinstance(part, bool) for part in value):
            return ",".join(map(str, value))
    elif isinstance(value, str) and not numeric:
        return value
    elif numeric and not isinstance(value, bool) and isinstance(value, (int, float) if kind is float else int):
        return str(value)
    raise InvalidInputError(f"{where}: expected {type_name(action)}, got {value!r}")
