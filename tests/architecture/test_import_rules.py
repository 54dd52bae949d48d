"""The import rules of ARCHITECTURE.md: packages import downwards only, and importing a package loads nothing heavy."""

import ast
from collections.abc import Iterator
from graphlib import TopologicalSorter
from pathlib import Path

import pytest
from other_process import run_python

ROOT = Path(__file__).resolve().parents[2]
SOURCE_FOLDERS = (ROOT / "src", *sorted((ROOT / "services").glob("*")))
GENERATED = "gausslite.v1"
STUDIES = ("gausslite_sim", "gausslite_bench")
BESIDE_THE_CORE = ("gausslite_view", "gausslite_ros")
SERVICES = ("gausslite_agent", "gausslite_fusion_server", "gausslite_parser")
MAY_USE_ARGPARSE = (
    "gausslite.cli",
    "gausslite.config",
    "gausslite_bench.cli",
    *(f"{each}.settings" for each in SERVICES),
)
CLIENTS = (
    "gausslite.api",
    "gausslite.cli",
    "gausslite.wire.clients",
    "gausslite.wire.channel",
    "gausslite.wire.uplink",
)
SERVERS = ("gausslite.wire.server", *SERVICES)
ROW_COLUMNS = ("MEAN", "QUAT", "LOG_SCALE", "OPACITY_LOGIT", "RGB", "UPDATE_COUNT")
MAY_USE_ROW_ENCODING = (
    "gausslite.mapping.anchors",
    "gausslite.mapping.density",
    "gausslite.mapping.splat_table",
    "gausslite.render",
)
HEAVY = ("torch", "onnxruntime", "onnx", "embreex", "matplotlib", "scipy.spatial", "gausslite.render._kernels")


def belongs_to(module: str, packages: tuple[str, ...]) -> bool:
    return any(module == package or module.startswith(f"{package}.") for package in packages)


def imports_of(tree: ast.AST, module: str) -> Iterator[str]:
    """Yield every module or name that the code imports, with its full path."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module}: expected absolute imports, got a relative one"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


@pytest.fixture(scope="module")
def imports() -> dict[str, set[str]]:
    """Return the imports of each module of the distribution."""
    found = {}
    for folder in SOURCE_FOLDERS:
        for path in sorted(folder.rglob("*.py")):
            module = ".".join(path.relative_to(folder).with_suffix("").parts).removesuffix(".__init__")
            if not belongs_to(module, (GENERATED,)):
                found[module] = set(imports_of(ast.parse(path.read_text()), module))
    assert len(found) > 200
    return found


def violations(
    imports: dict[str, set[str]], sources: tuple[str, ...], forbidden: tuple[str, ...], allowed: tuple[str, ...] = ()
) -> list[str]:
    """Return "module -> import" for each forbidden import of the modules in `sources`, except those in `allowed`."""
    return [
        f"{module} -> {each}"
        for module, imported in sorted(imports.items())
        if belongs_to(module, sources) and not belongs_to(module, allowed)
        for each in sorted(imported)
        if belongs_to(each, forbidden)
    ]


def test_layers_of_pyproject_hold() -> None:
    pytest.importorskip("importlinter", reason="import-linter comes with the dev extra")
    done = run_python("-c", "from importlinter.cli import lint_imports_command; lint_imports_command()", cwd=ROOT)
    assert done.returncode == 0, done.stdout + done.stderr


def test_the_core_finds_the_packages_beside_it_by_name(imports: dict[str, set[str]]) -> None:
    found_by_name = (*STUDIES, *BESIDE_THE_CORE)
    assert violations(imports, ("gausslite", *SERVICES), found_by_name, allowed=BESIDE_THE_CORE) == []


def test_no_modules_import_each_other(imports: dict[str, set[str]]) -> None:
    graph = {
        module: {each if each in imports else each.rpartition(".")[0] for each in imported} - {module}
        for module, imported in imports.items()
    }
    # raises CycleError with the circle, also of imports inside functions and for types
    order = list(TopologicalSorter(graph).static_order())
    assert set(imports) <= set(order)


def test_the_simulator_does_not_import_the_benchmarks(imports: dict[str, set[str]]) -> None:
    assert violations(imports, ("gausslite_sim",), ("gausslite_bench",)) == []


def test_the_core_does_not_import_the_services(imports: dict[str, set[str]]) -> None:
    assert violations(imports, ("gausslite", *STUDIES), SERVICES) == []


def test_clients_never_import_servers(imports: dict[str, set[str]]) -> None:
    assert violations(imports, CLIENTS, SERVERS) == []


def test_argparse_stays_at_the_edges(imports: dict[str, set[str]]) -> None:
    everything = ("gausslite", *STUDIES, *SERVICES)
    assert violations(imports, everything, ("argparse",), allowed=MAY_USE_ARGPARSE) == []


def test_only_optimisation_and_rendering_use_the_row_encoding(imports: dict[str, set[str]]) -> None:
    columns = tuple(f"gausslite.render.rasterizer.{name}" for name in ROW_COLUMNS)
    assert violations(imports, ("gausslite", "gausslite_sim"), columns, allowed=MAY_USE_ROW_ENCODING) == []


def test_importing_the_packages_loads_nothing_heavy() -> None:
    modules = (
        "gausslite",
        "gausslite.api",
        "gausslite.cli.main",
        "gausslite.domain.frame",
        "gausslite.mission.task_mapper",
        "gausslite.mission.runner",
        "gausslite.perception.relevance",
        "gausslite.fusion.vote",
        "gausslite.wire.clients",
        "gausslite_sim",
        "gausslite_bench",
    )
    # after each import, so that the message names the module that loads something
    code = (
        "import importlib, sys\n"
        f"for module in {modules!r}:\n"
        "    importlib.import_module(module)\n"
        f"    print(*[(module, name) for name in {HEAVY!r} if name in sys.modules], end='')"
    )
    done = run_python("-c", code)
    assert done.returncode == 0, done.stderr
    assert done.stdout == ""


@pytest.mark.parametrize(
    ("program", "unused"),
    [
        ("gausslite_parser.program", ("datasets", "mapping", "render", "perception", "calibration", "fusion", "view")),
        ("gausslite_fusion_server.program", ("datasets", "perception", "calibration", "view")),
    ],
)
def test_a_program_imports_what_it_uses(program: str, unused: tuple[str, ...]) -> None:
    code = f"import sys, {program}; print(*[name for name in sys.modules if name.startswith('gausslite.')])"
    done = run_python("-c", code)
    assert done.returncode == 0, done.stderr
    packages = tuple(f"gausslite.{package}" for package in unused)
    assert [name for name in done.stdout.split() if belongs_to(name, packages)] == []


def test_help_lists_every_command_without_numpy() -> None:
    code = (
        "import sys\nfrom gausslite.cli.main import main\n"
        "try:\n    main(['--help'])\nexcept SystemExit as end:\n    assert end.code == 0\n"
        "assert 'numpy' not in sys.modules"
    )
    done = run_python("-c", code)
    assert done.returncode == 0, done.stderr
    for command in ("map", "demo", "parse", "eval", "fuse", "models", "bench"):
        assert command in done.stdout
