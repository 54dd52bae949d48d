"""Import packages of the optional extras when a format needs them."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from gausslite.domain.errors import InvalidInputError


def import_extra(package: str, extra: str, purpose: str) -> Any:
    """Import a package of an extra. Raises InvalidInputError, which names the command that installs it."""
    try:
        return import_module(package)
    except ImportError as error:
        raise InvalidInputError(
            f"{purpose}: expected the package {package!r}; install it with: pip install 'gausslite[{extra}]'"
        ) from error
