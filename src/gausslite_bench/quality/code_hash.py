"""Tell one state of the code from another: figures are compared only where the same code gave them."""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

import gausslite

_SOURCES = Path(gausslite.__file__).parent.parent
_PACKAGES = ("gausslite", "gausslite_bench", "gausslite_sim")
_NEVER_IMPORTED = {"gausslite": ("cli", "config", "fusion", "models", "v1", "wire"), "gausslite_bench": ("cli",)}
"""Subpackages that a trial does not import: a change there cannot change its result."""


@functools.cache
def current_code_hash() -> str:
    """Of this package's sources and kernels as they lie on disk when it is first asked for.

    Other libraries are not in it, nor is the processor. Read once: a program goes on with the code it started with.
    """
    return hash_files(trial_source_files())


def hash_files(files: Sequence[Path]) -> str:
    """A short text that changes with every byte of these files, their names and their order."""
    digest = hashlib.sha256()
    for path in files:
        content = path.read_bytes()
        digest.update(f"{path.name} {len(content)}\n".encode() + content)
    return digest.hexdigest()[:16]


def trial_source_files() -> list[Path]:
    """All that a trial may run, in an order that is the same everywhere."""
    sources = [path for package in _PACKAGES for path in (_SOURCES / package).rglob("*.py") if _is_imported(path)]
    sources.sort(key=lambda path: path.relative_to(_SOURCES).as_posix())
    # an editable install keeps the kernels elsewhere than the sources
    kernels = find_spec("gausslite.render._kernels")
    return sources if kernels is None or kernels.origin is None else [*sources, Path(kernels.origin)]


def _is_imported(path: Path) -> bool:
    package, *inner = path.relative_to(_SOURCES).parts
    return inner[0] not in _NEVER_IMPORTED.get(package, ())
