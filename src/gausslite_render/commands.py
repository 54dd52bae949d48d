"""The sub-command of `gausslite` that this package adds."""

from __future__ import annotations

from typing import Final

from gausslite.plugins import Command

RENDER: Final = Command("render images, depth and video of a splat map along given poses", "gausslite_render.command")
