"""Run every test with the shapes in the type annotations checked, and find the data that may lie beside the project."""

from __future__ import annotations

from pathlib import Path

import pytest
from jaxtyping import install_import_hook

# an int is a float here, as it is for the type checker
install_import_hook(
    ("gausslite", "gausslite_sim", "gausslite_bench"),
    "beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True))",
)


@pytest.fixture(scope="session")
def shared_dir() -> Path:
    """The folder `shared` beside the project with real sequences and models; skips where there is none."""
    folder = Path(__file__).resolve().parents[2] / "shared"
    if not folder.is_dir():
        pytest.skip(f"no real sequences and models here: {folder} is absent")
    return folder
