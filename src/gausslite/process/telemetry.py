"""Switch off the telemetry of libraries; call it before the import of a library that has any."""

from __future__ import annotations

import os

_SWITCHES = {"ORT_DISABLE_TELEMETRY": "1"}
"""Variables that ONNX Runtime reads when it is loaded, also as a part of onnxruntime-genai."""


def disable_telemetry() -> None:
    """Set the variables for this process and its children."""
    os.environ.update(_SWITCHES)
