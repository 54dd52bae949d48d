"""Hash of the code that a trial runs: results of different code are not compared."""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

_SOURCES = Path(__file__).resolve().parents[2]
"""The folder of the packages that a trial runs."""
_PACKAGES = ("gausslite", "gausslite_bench", "gausslite_sim")
_NEVER_IMPORTED = {"gausslite": ("cli", "fusion", "v1", "wire"), "gausslite_bench": ("cli",)}
"""Subpackages that a trial does not import, so that their changes cannot affect its result."""


@functools.cache
def current_code_hash() -> str:
    """Return the hash of the sources and kernels on disk at the first call.

    It excludes other libraries and the processor. It is cached, since a process keeps running the code it loaded.
    """
    return hash_files(trial_source_files())


def hash_files(files: Sequence[Path]) -> str:
    """Return a short SHA-256 digest of these files' contents, names and order."""
    digest = hashlib.sha256()
    for path in files:
        content = path.read_bytes()
        digest.update(f"{path.name} {len(content)}\n".encode() + content)
    return digest.hexdigest()[:16]


def trial_source_files() -> list[Path]:
    """Return all files that a trial may run, in the same order on every machine."""
    sources = [path for package in _PACKAGES for path in (_SOURCES / package).rglob("*.py") if _is_imported(path)]
    sources.sort(key=lambda path: path.relative_to(_SOURCES).as_posix())
    # an editable installation stores the kernels apart from the sources
    kernels = [find_spec(name) for name in ("gausslite.render._kernels", "gausslite.codec._unpack")]
    return [*sources, *(Path(spec.origin) for spec in kernels if spec is not None and spec.origin is not None)]


def _is_imported(path: Path) -> bool:
    package, *inner = path.relative_to(_SOURCES).parts
    return inner[0] not in _NEVER_IMPORTED.get(package, ())
