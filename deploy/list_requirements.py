"""List the requirements of pyproject.toml as files for pip: `list_requirements.py PYPROJECT EXTRAS FOLDER`."""

from __future__ import annotations

import sys
import tomllib
from pathlib import Path


def main(pyproject: str, extras: str, folder: str) -> None:
    """Write runtime.txt, with the requirements of these comma-separated extras, and build.txt."""
    content = tomllib.loads(Path(pyproject).read_text())
    project = content["project"]
    optional = project["optional-dependencies"]
    names = [name for name in extras.split(",") if name]
    unknown = [name for name in names if name not in optional]
    if unknown:
        sys.exit(f"EXTRAS: expected names of {', '.join(optional)}, got {', '.join(unknown)}")
    runtime = [*project["dependencies"], *(line for name in names for line in optional[name])]
    # without build isolation pip does not install what the build backend itself asks for
    build = [*content["build-system"]["requires"], "cmake>=3.20", "ninja>=1.10"]
    Path(folder).mkdir(parents=True, exist_ok=True)
    for name, lines in (("runtime.txt", runtime), ("build.txt", build)):
        (Path(folder) / name).write_text("".join(f"{line}\n" for line in lines))


if __name__ == "__main__":
    main(*sys.argv[1:])
