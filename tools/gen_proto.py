#!/usr/bin/env python3
"""Generate src/gausslite/v1 from proto/: one pinned compiler in its own environment, so that bytes never differ.

    tools/gen_proto.py            write the code
    tools/gen_proto.py --check    generate to a temporary folder and compare; exit 1 where the committed code is stale

The compiler has an environment of its own, because generated code refuses a runtime older than its compiler.
"""

from __future__ import annotations

import argparse
import filecmp
import shutil
import subprocess
import sys
import tempfile
import venv
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PROTO = ROOT / "proto"
GENERATED = ROOT / "src" / "gausslite" / "v1"
TOOLS = ("grpcio-tools==1.80.0", "mypy-protobuf==5.1.0")
ENVIRONMENT = ROOT / "build" / "proto-tools"
PACKAGE_INIT = '"""GENERATED from proto/ by tools/gen_proto.py: the messages and stubs of gausslite.v1."""\n'


def compiler() -> Path:
    """The bin folder of an environment that holds exactly TOOLS, made on first use."""
    stamp = ENVIRONMENT / "tools.txt"
    if not stamp.is_file() or stamp.read_text() != "\n".join(TOOLS):
        shutil.rmtree(ENVIRONMENT, ignore_errors=True)
        venv.create(ENVIRONMENT, with_pip=True)
        subprocess.run([ENVIRONMENT / "bin" / "pip", "install", "--quiet", *TOOLS], check=True)
        stamp.write_text("\n".join(TOOLS))
    return ENVIRONMENT / "bin"


def generate(target: Path) -> None:
    """Write the package gausslite/v1 into `target`."""
    bin_dir = compiler()
    with tempfile.TemporaryDirectory() as scratch:
        outputs = [f"--{kind}_out={scratch}" for kind in ("python", "grpc_python")]
        outputs += [f"--{kind}_out=quiet:{scratch}" for kind in ("mypy", "mypy_grpc")]
        plugins = [f"--plugin={bin_dir / name}" for name in ("protoc-gen-mypy", "protoc-gen-mypy_grpc")]
        files = sorted(str(path.relative_to(PROTO)) for path in PROTO.rglob("*.proto"))
        subprocess.run(
            [bin_dir / "python", "-m", "grpc_tools.protoc", f"-I{PROTO}", *plugins, *outputs, *files], check=True
        )
        shutil.rmtree(target, ignore_errors=True)
        shutil.copytree(Path(scratch) / "gausslite" / "v1", target)
    # a file without a service leaves an empty grpc module behind
    for stub in target.glob("*_pb2_grpc.py*"):
        if "_service_" not in stub.name:
            stub.unlink()
    (target / "__init__.py").write_text(PACKAGE_INIT)


def stale_files(fresh: Path) -> list[str]:
    """Names that differ between the committed code and `fresh`."""
    names = {path.name for folder in (fresh, GENERATED) for path in folder.glob("*.py*") if path.is_file()}
    _, mismatch, missing = filecmp.cmpfiles(fresh, GENERATED, sorted(names), shallow=False)
    return sorted([*mismatch, *missing])


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="compare only")
    if not parser.parse_args().check:
        generate(GENERATED)
        return 0
    with tempfile.TemporaryDirectory() as scratch:
        fresh = Path(scratch) / "v1"
        generate(fresh)
        stale = stale_files(fresh)
    if stale:
        print(f"stale: {', '.join(stale)}; run tools/gen_proto.py", file=sys.stderr)
    return 1 if stale else 0


if __name__ == "__main__":
    sys.exit(main())
