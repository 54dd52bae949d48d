"""Read option values from environment variables: GAUSSLITE_MAX_GAUSSIANS sets --max-gaussians."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Final

from gausslite.config.known_options import KNOWN_OPTIONS
from gausslite.config.nearest import suggestion
from gausslite.config.option_table import Layer, OptionTable, RawValue, variable_name
from gausslite.domain.errors import InvalidInputError

PREFIX: Final = "GAUSSLITE_"
CONFIG_VARIABLE: Final = "GAUSSLITE_CONFIG"
KEY_VARIABLE: Final = "GAUSSLITE_LLM_API_KEY"
_OTHER_VARIABLES: Final = frozenset(
    {
        CONFIG_VARIABLE,
        KEY_VARIABLE,
        "GAUSSLITE_SIMD",
        # of deploy/, of the native build and of the tests
        *("GAUSSLITE_AGENTS", "GAUSSLITE_CERTS", "GAUSSLITE_CERT_DAYS", "GAUSSLITE_EXTRAS", "GAUSSLITE_FUSION_PORT"),
        *("GAUSSLITE_LLM", "GAUSSLITE_MODELS", "GAUSSLITE_RECORDINGS", "GAUSSLITE_SOURCES", "GAUSSLITE_TASKS"),
        *("GAUSSLITE_SANITIZE", "GAUSSLITE_ONNX_TASKS", "GAUSSLITE_CPP_CLIENT"),
        "GAUSSLITE_CPP_BUILD",
    }
)
"""Variables with the prefix that are not options, or only options of one program."""
_SWITCHES: Final = {
    **dict.fromkeys(("1", "true", "yes", "on"), True),
    **dict.fromkeys(("0", "false", "no", "off"), False),
}


def read_environment(table: OptionTable, environment: Mapping[str, str]) -> Layer:
    """Return the option values of the environment; empty variables count as unset. Raises InvalidInputError.

    A repeatable option takes one value per line.
    """
    values: dict[str, RawValue] = {}
    for dest in table.actions:
        name = variable_name(table.key(dest))
        text = environment.get(name, "")
        if not text:
            continue
        if table.is_switch(dest):
            if text.lower() not in _SWITCHES:
                raise InvalidInputError(f"{name}: expected true or false, got {text!r}")
            values[dest] = _SWITCHES[text.lower()]
        else:
            values[dest] = text.splitlines() if table.is_repeatable(dest) else text
    for dest in values:
        for rival in table.exclusive_with(dest) & values.keys():
            names = " and ".join(sorted(variable_name(table.key(each)) for each in (dest, rival)))
            raise InvalidInputError(f"environment: expected only one of {names}, got both")
    return Layer(values, {dest: variable_name(table.key(dest)) for dest in values})


def describe_unknown_variables(
    options: Collection[str], environment: Mapping[str, str], key_variable: str | None
) -> list[str]:
    """Return a message for every variable with the prefix that nothing reads, without its value.

    Options of other programs give no warning: one environment may configure several programs. options: names of the
    program's options, without dashes in front. key_variable: the variable that the options name for the API key.
    """
    known = {variable_name(key) for key in (*options, *KNOWN_OPTIONS)} | _OTHER_VARIABLES
    unknown = sorted(
        name for name in environment if name.startswith(PREFIX) and name not in known and name != key_variable
    )
    # the common prefix would make all names similar
    names = [name.removeprefix(PREFIX) for name in known]
    return [f"{name} is not an option{suggestion(name.removeprefix(PREFIX), names, PREFIX)}" for name in unknown]


def without_options(environment: Mapping[str, str]) -> dict[str, str]:
    """Return the environment without option variables, for child processes that read their own configuration file."""
    return {
        name: value for name, value in environment.items() if not name.startswith(PREFIX) or name in _OTHER_VARIABLES
    }
