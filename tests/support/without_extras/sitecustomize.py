"""Hide packages from this process and its children, as if they were not installed.

Python imports this file at its start if its folder is in PYTHONPATH. HIDDEN_PACKAGES: their import names, by commas.
"""

import os
import sys
from collections.abc import Collection
from importlib.machinery import ModuleSpec
from typing import Any

_VARIABLE = "HIDDEN_PACKAGES"


class _VisiblePackages:
    """A finder of modules that finds no hidden package."""

    def __init__(self, finder: Any) -> None:
        self._finder = finder

    def __getattr__(self, name: str) -> Any:
        return getattr(self._finder, name)

    def find_spec(self, name: str, path: Any = None, target: Any = None) -> ModuleSpec | None:
        """Return the module's specification, None for a hidden one."""
        if name.partition(".")[0] in hidden_packages():
            return None
        found: ModuleSpec | None = self._finder.find_spec(name, path, target)
        return found


def hidden_packages() -> set[str]:
    """Return the import names of the hidden packages."""
    return set(os.environ.get(_VARIABLE, "").split(","))


def show_packages(names: Collection[str]) -> None:
    """Hide these packages no longer, in this process and in those that it starts."""
    os.environ[_VARIABLE] = ",".join(sorted(hidden_packages() - set(names)))


sys.meta_path[:] = [_VisiblePackages(finder) for finder in sys.meta_path]
