"""Replace what is registered in a group of plug-ins during a test, as if other packages were installed."""

from importlib.metadata import EntryPoint

import pytest

from gausslite import plugins


def register(monkeypatch: pytest.MonkeyPatch, group: plugins.Group, **values: str) -> None:
    """Let a group have these plug-ins only, by name, each as "module:object"."""
    before = plugins._registered

    def registered(asked: plugins.Group) -> dict[str, EntryPoint]:
        if asked is not group:
            return before(asked)
        return {name: EntryPoint(name, value, group) for name, value in values.items()}

    monkeypatch.setattr(plugins, "_registered", registered)
