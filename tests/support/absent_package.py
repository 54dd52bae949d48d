"""Let a package beside the core be absent for a test."""

import sys

import pytest


def remove_package(monkeypatch: pytest.MonkeyPatch, package: str) -> None:
    """Make every import of the package fail as if it were not installed, until the test ends."""
    for module in [name for name in sys.modules if name.partition(".")[0] == package]:
        monkeypatch.delitem(sys.modules, module)
    # what the import system finds as None is not imported
    monkeypatch.setitem(sys.modules, package, None)
