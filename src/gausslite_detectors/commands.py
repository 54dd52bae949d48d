"""The sub-commands of `gausslite` that this package adds."""

from __future__ import annotations

from typing import Final

from gausslite.plugins import Command

MODELS: Final = Command(
    "list the model files for detection and segmentation, print how each is made, and inspect one",
    "gausslite_detectors.models_command",
)
