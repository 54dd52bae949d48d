"""The sub-command of `gausslite` that this package adds."""

from __future__ import annotations

from typing import Final

from gausslite.plugins import Command

MCP: Final = Command("serve a map's objects, goals and views to language models (MCP)", "gausslite_mcp.command")
