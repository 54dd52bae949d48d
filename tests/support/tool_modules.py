"""Load the scripts of tools/ as modules."""

import importlib.util
import sys
from functools import cache
from pathlib import Path
from types import ModuleType


@cache
def load_tool(name: str) -> ModuleType:
    """Return tools/NAME.py as a module."""
    path = Path(__file__).resolve().parents[2] / "tools" / f"{name}.py"
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module
