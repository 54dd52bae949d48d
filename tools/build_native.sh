#!/bin/sh
# Builds the native modules into the source tree, for development: tools/build_native.sh [PYTHON]. Installing the package does not need it.
set -eu
root=$(cd "$(dirname "$0")/.." && pwd)
python=${1:-python3}
cmake -S "$root/native" -B "$root/build/dev" -DPython_EXECUTABLE="$("$python" -c 'import sys; print(sys.executable)')" \
  -Dnanobind_DIR="$("$python" -m nanobind --cmake_dir)" >/dev/null
cmake --build "$root/build/dev" --parallel "$(nproc)"
rm -f "$root"/src/gausslite/render/_kernels*.so "$root"/src/gausslite/codec/_unpack*.so
cp "$root"/build/dev/_kernels*.so "$root/src/gausslite/render/"
cp "$root"/build/dev/_unpack*.so "$root/src/gausslite/codec/"
