"""Import all modules, and run commands and programs, in a process that sees no optional package; print JSON.

Arguments: a folder for results, the import names of the packages of the extra `sim`, which the runs may use, and
"all" to run more than what is quick.
"""

import contextlib
import importlib
import io
import json
import pkgutil
import sys
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path

import sitecustomize

PROGRAMS = ("gausslite_agent", "gausslite_fusion_server", "gausslite_parser")
TASK = "Pick up the mug on the table"
SOURCE, FRAMES = "sim:home?size=160x120", ("--frames", "0:3")


def failed_imports() -> dict[str, str]:
    """Return the missing package, or the error, of each module that cannot be imported."""
    failed: dict[str, str] = {}
    beside = Path(str(importlib.import_module("gausslite").__file__)).parents[1].glob("gausslite*/__init__.py")
    for package in (*(path.parent.name for path in beside), *PROGRAMS):
        for module in pkgutil.walk_packages(importlib.import_module(package).__path__, f"{package}."):
            try:
                importlib.import_module(module.name)
            except ModuleNotFoundError as error:
                failed[module.name] = str(error.name)
            except Exception as error:
                failed[module.name] = repr(error)
    api = importlib.import_module("gausslite.api")
    for name in api.__all__:
        getattr(importlib.import_module("gausslite"), name)
    return failed


def run(program: str, arguments: Sequence[str]) -> dict[str, object]:
    """Run a command line in this process. Returns its exit code, and what it writes to stderr."""
    messages = io.StringIO()
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(messages):
        try:
            code: object = _main(program)(list(arguments))
        except SystemExit as end:
            code = end.code
        except BaseException:
            traceback.print_exc()
            code = None
    return {"arguments": [program, *arguments], "code": code, "messages": messages.getvalue().splitlines()}


def _main(program: str) -> Callable[[list[str]], object]:
    if program == "gausslite":
        return importlib.import_module("gausslite.cli.main").main  # type: ignore[no-any-return]
    return importlib.import_module(f"{program}.program").run  # type: ignore[no-any-return]


def default_paths(out: Path, runs_all: bool) -> list[dict[str, object]]:
    """Run what README and the help promise without any extra but `sim`."""
    run_folder, map_file = str(out / "map"), str(out / "map" / "map.ply")
    few = ("--set", "frames=0:6:3", "--set", "refine-iterations=5")
    quick = (
        ("map", SOURCE, "--task", TASK, *FRAMES, "--out", run_folder),
        ("parse", TASK),
        ("models", "list"),
        *((command, "--help") for command in importlib.import_module("gausslite.cli.main").commands()),
    )
    others = (
        ("map", SOURCE, *FRAMES, "--out", str(out / "uniform")),
        ("eval", map_file, SOURCE, *FRAMES),
        ("fuse", map_file, str(out / "uniform" / "map.ply"), "--out", str(out / "fused.ply")),
        ("report", run_folder),
        ("objects", run_folder),
        ("export", run_folder, "--to", "ply"),
        ("calibrate", "sim:home?frames=12&size=160x120&drift=2%"),
        ("doctor", "--json"),
        ("demo", *few, "--size", "160x120", "--out", str(out / "demo")),
    )
    results = [run("gausslite", arguments) for arguments in (*quick, *(others if runs_all else ()))]
    return results + [run(program, ("--help",)) for program in PROGRAMS]


def missing_extras(out: Path) -> list[dict[str, object]]:
    """Run what needs an extra; each result has the extra."""
    run_folder = str(out / "map")
    cases = [
        ("view", "gausslite", ("map", SOURCE, *FRAMES, "--out", str(out / "view"), "--set", "view=0")),
        ("view", "gausslite", ("demo", "--out", str(out / "view"), "--set", "view=0")),
        ("view", "gausslite", ("view", run_folder, "--port", "0")),
        ("view", "gausslite_agent", ("--listen", "127.0.0.1:50099", "--set", "view=0")),
        ("view", "gausslite_fusion_server", ("--listen", "127.0.0.1:50099", "--view", "0")),
        ("metrics", "gausslite_fusion_server", ("--listen", "127.0.0.1:50099", "--metrics", "127.0.0.1:0")),
        ("mcp", "gausslite", ("mcp", run_folder)),
        *(("export", "gausslite", ("export", run_folder, "--to", kind)) for kind in ("spz", "las", "octomap", "mesh")),
        ("rerun", "gausslite", ("export", run_folder, "--to", "rrd")),
        ("cuda", "gausslite", ("map", SOURCE, *FRAMES, "--out", str(out / "cuda"), "--set", "rasterizer=cuda")),
    ]
    return [{"extra": extra, **run(program, arguments)} for extra, program, arguments in cases]


def main() -> None:
    """Print what fails to import, and the results of all runs."""
    out, sim, runs_all = Path(sys.argv[1]), sys.argv[2].split(","), sys.argv[3:] == ["all"]
    imports = failed_imports()
    without_sim = {"extra": "sim", **run("gausslite", ("map", SOURCE, "--task", TASK, "--out", str(out / "no")))}
    sitecustomize.show_packages(sim)
    results = default_paths(out, runs_all)
    missing = [without_sim, *missing_extras(out)]
    print(json.dumps({"imports": imports, "default_paths": results, "missing_extras": missing}))


if __name__ == "__main__":
    main()
