"""Open an ONNX model that a user gave us, or say in one line what is wrong with the file."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from gausslite.errors import ModelFileError


def open_session(path: Path, threads: int | None) -> Any:
    """An inference session on the CPU. Raises ModelFileError when the file is missing or no ONNX model."""
    if not path.is_file():
        raise ModelFileError(f"model {path}: expected an ONNX file, found {'a folder' if path.is_dir() else 'nothing'}")
    # read before the import: newer runtimes report their use over the network otherwise
    os.environ["ORT_DISABLE_TELEMETRY"] = "1"
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4
    if threads is not None:
        options.intra_op_num_threads = threads
    try:
        return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except Exception as error:
        # the runtime has a dozen exception types without a common base, and none says more than this
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ModelFileError(f"model {path}: expected a readable ONNX model, but {reason}") from error
