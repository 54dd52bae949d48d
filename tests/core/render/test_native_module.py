"""The built extensions: their type stubs match, and they need only system libraries."""

import ast
import inspect
import re
import shutil
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

import gausslite
from gausslite.codec import _unpack

kernels = pytest.importorskip("gausslite.render._kernels", reason="the native kernels are not built")

MODULES = (kernels, _unpack)
PACKAGE = Path(gausslite.__file__).parent
SYSTEM_LIBRARY = re.compile(r"(libstdc\+\+|libgcc_s|libm|libc|libpthread|ld-linux[\w-]*)\.so\.\d+")

Interface = dict[str, tuple[str, ...] | None]
"""Parameter names by dotted function name; None for a property."""


def stub_of(module: ModuleType) -> Path:
    return PACKAGE.joinpath(*module.__name__.split(".")[1:]).with_suffix(".pyi")


def stub_interface(module: ModuleType) -> Interface:
    interface: Interface = {}
    for node in ast.parse(stub_of(module).read_text()).body:
        if isinstance(node, ast.FunctionDef):
            interface[node.name] = tuple(a.arg for a in node.args.args)
        if isinstance(node, ast.ClassDef):
            for member in node.body:
                if isinstance(member, ast.FunctionDef):
                    parameters = tuple(a.arg for a in member.args.args[1:])
                    interface[f"{node.name}.{member.name}"] = None if member.decorator_list else parameters
    return interface


def module_interface(module: ModuleType) -> Interface:
    interface: Interface = {}
    for name, value in vars(module).items():
        if inspect.isclass(value):
            for member, attribute in vars(value).items():
                if not member.startswith("_"):
                    interface[f"{name}.{member}"] = (
                        None if isinstance(attribute, property) else _parameters(attribute)[1:]
                    )
        elif not name.startswith("_"):
            interface[name] = _parameters(value)
    if module is not kernels:
        return interface
    # nb::new_ creates objects in __new__
    for cls in (kernels.Engine, kernels.View):
        interface[f"{cls.__name__}.__init__"] = _parameters(cls.__new__)[1:]
    for cls in (kernels.StepScene, kernels.StepTraining):
        interface[f"{cls.__name__}.__init__"] = _parameters(cls.__init__)[1:]
    return interface


def _parameters(function: Any) -> tuple[str, ...]:
    """Return the parameter names of the last overload, from nanobind's signature."""
    signature = function.__nb_signature__[-1][0]
    while "[" in signature:
        signature = re.sub(r"\[[^][]*\]", "", signature)
    inner = re.search(r"\((.*)\)", signature)[1]
    return tuple(part.split(":")[0].strip() for part in inner.split(",") if part.strip())


@pytest.mark.parametrize("module", MODULES)
def test_stubs_match_the_module(module: ModuleType) -> None:
    assert stub_interface(module) == module_interface(module)


def test_type_information_is_installed() -> None:
    assert (PACKAGE / "py.typed").is_file()
    assert all(stub_of(module).is_file() for module in MODULES)


@pytest.mark.parametrize("module", MODULES)
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="needs ELF")
def test_module_needs_only_system_libraries(module: ModuleType) -> None:
    readelf = shutil.which("readelf")
    if readelf is None:
        pytest.skip("readelf is missing (binutils)")
    listing = subprocess.run([readelf, "-d", str(module.__file__)], capture_output=True, text=True, check=True).stdout
    needed = re.findall(r"\(NEEDED\).*\[(.+)\]", listing)
    assert "libc.so.6" in needed
    assert [name for name in needed if not SYSTEM_LIBRARY.fullmatch(name)] == []
