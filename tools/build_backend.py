"""Build GaussLite by scikit-build-core: in the source's build folder if that can be written, else in the user's cache.

Root's clones and read-only mounts can be installed so. The folder lets a second installation skip the kernels'
compilation.
"""

from __future__ import annotations

import hashlib
import os
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from scikit_build_core import build

get_requires_for_build_sdist = build.get_requires_for_build_sdist
get_requires_for_build_wheel = build.get_requires_for_build_wheel
get_requires_for_build_editable = build.get_requires_for_build_editable
prepare_metadata_for_build_wheel = build.prepare_metadata_for_build_wheel
prepare_metadata_for_build_editable = build.prepare_metadata_for_build_editable
build_sdist = build.build_sdist


def _can_write(folder: Path) -> bool:
    """True if this user can write the folder, which is created, and all in it."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        return all(os.access(path, os.W_OK) for path in (folder, *folder.iterdir()))
    except OSError:
        return False


def _build(
    of_kind: Callable[..., str],
    wheel_directory: str,
    config_settings: dict[str, Any] | None = None,
    metadata_directory: str | None = None,
) -> str:
    settings = dict(config_settings or {})
    if "build-dir" in settings or _can_write(Path("build")):
        return of_kind(wheel_directory, settings, metadata_directory)
    # CMake refuses the folder of a source at another place
    source = hashlib.sha256(os.fsencode(Path.cwd())).hexdigest()[:16]
    # Path.expanduser fails for a user without a home, as in a container
    caches = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")  # noqa: PTH111
    cache = Path(caches) / "gausslite" / source
    # `sudo pip` may have left a folder of root
    if _can_write(cache):
        return of_kind(wheel_directory, {**settings, "build-dir": f"{cache}/{{wheel_tag}}"}, metadata_directory)
    with tempfile.TemporaryDirectory(prefix="gausslite-build-") as folder:
        return of_kind(wheel_directory, {**settings, "build-dir": folder}, metadata_directory)


build_wheel = partial(_build, build.build_wheel)
build_editable = partial(_build, build.build_editable)
