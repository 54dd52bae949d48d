"""The built extension as it is shipped: its stub tells the truth, and it needs no library that a system may lack."""

from __future__ import annotations

import ast
import inspect
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import gausslite

kernels = pytest.importorskip("gausslite.render._kernels", reason="the native kernels are not built")

PACKAGE = Path(gausslite.__file__).parent
OF_THE_SYSTEM = re.compile(r"(libstdc\+\+|libgcc_s|libm|libc|libpthread|ld-linux[\w-]*)\.so\.\d+")

Interface = dict[str, tuple[str, ...] | None]
"""By dotted name: the parameters' names of a function, None for a property."""


def stub_interface() -> Interface:
    interface: Interface = {}
    for node in ast.parse((PACKAGE / "render" / "_kernels.pyi").read_text()).body:
        if isinstance(node, ast.FunctionDef):
            interface[node.name] = tuple(a.arg for a in node.args.args)
        if isinstance(node, ast.ClassDef):
            for member in node.body:
                if isinstance(member, ast.FunctionDef):
                    parameters = tuple(a.arg for a in member.args.args[1:])
                    interface[f"{node.name}.{member.name}"] = None if member.decorator_list else parameters
    return interface


def module_interface() -> Interface:
    interface: Interface = {}
    for name, value in vars(kernels).items():
        if inspect.isclass(value):
            for member, found in vars(value).items():
                if not member.startswith("_"):
                    interface[f"{name}.{member}"] = None if isinstance(found, property) else _parameters(found)[1:]
        elif not name.startswith("_"):
            interface[name] = _parameters(value)
    # nb::new_ makes an object in __new__
    for made in (kernels.Engine, kernels.View):
        interface[f"{made.__name__}.__init__"] = _parameters(made.__new__)[1:]
    for made in (kernels.StepScene, kernels.StepTraining):
        interface[f"{made.__name__}.__init__"] = _parameters(made.__init__)[1:]
    return interface


def _parameters(function: Any) -> tuple[str, ...]:
    """Names of the last overload's parameters, from what nanobind keeps of the binding."""
    signature = function.__nb_signature__[-1][0]
    while "[" in signature:
        signature = re.sub(r"\[[^][]*\]", "", signature)
    inner = re.search(r"\((.*)\)", signature)[1]
    return tuple(part.split(":")[0].strip() for part in inner.split(",") if part.strip())


def test_the_stub_has_what_the_module_has() -> None:
    assert stub_interface() == module_interface()


def test_the_types_are_shipped() -> None:
    assert (PACKAGE / "py.typed").is_file()
    assert (PACKAGE / "render" / "_kernels.pyi").is_file()


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="ELF modules are Linux's")
def test_the_module_needs_nothing_beyond_the_systems_libraries() -> None:
    readelf = shutil.which("readelf")
    if readelf is None:
        pytest.skip("readelf is missing (binutils)")
    listing = subprocess.run([readelf, "-d", kernels.__file__], capture_output=True, text=True, check=True).stdout
    needed = re.findall(r"\(NEEDED\).*\[(.+)\]", listing)
    assert "libc.so.6" in needed
    assert [name for name in needed if not OF_THE_SYSTEM.fullmatch(name)] == []
