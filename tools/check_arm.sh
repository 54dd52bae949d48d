#!/usr/bin/env bash
# Tests the NEON kernels without an ARM machine: tools/check_arm.sh FOLDER [PYTEST ARGUMENTS].
# Cross-compiles the extension and runs the kernels' tests and the rasterizer contract in an arm64 Python under qemu's user
# emulation; FOLDER (1.3 GB) keeps that Python and its packages for the next time. On Debian or Ubuntu, as root for debootstrap:
# apt install debootstrap qemu-user-static g++-aarch64-linux-gnu cmake; and nanobind for the Python in $PYTHON (default python3).
set -euo pipefail
root=$(cd "$(dirname "$0")/.." && pwd)
[ $# -gt 0 ] || { echo "check_arm: expected a folder to work in" >&2; exit 1; }
mkdir -p "$1"
folder=$(cd "$1" && pwd)
shift
python=${PYTHON:-python3}
for tool in debootstrap qemu-aarch64-static aarch64-linux-gnu-g++ cmake; do
  command -v $tool >/dev/null || { echo "check_arm: $tool is missing; see the first lines of $0" >&2; exit 1; }
done

# The packages are unpacked, not installed: that runs no arm64 code.
sysroot=$folder/root
if [ ! -e "$folder/root.done" ]; then
  rm -rf "$sysroot"
  debootstrap --arch=arm64 --foreign --variant=minbase --include=python3.11,libpython3.11-dev bookworm "$sysroot" >"$folder/root.log"
  for package in "$sysroot"/var/cache/apt/archives/*.deb; do dpkg-deb --extract "$package" "$sysroot"; done
  touch "$folder/root.done"
fi
# All packages are listed, because pip would choose the dependencies of the machine it runs on. torch 2.6 is the last without CUDA on arm64.
if [ ! -e "$folder/packages.done" ]; then
  "$python" -m pip install --quiet --no-deps --upgrade --target "$folder/packages" --only-binary=:all: --python-version 3.11 \
    --platform manylinux_2_28_aarch64 --platform manylinux_2_27_aarch64 --platform manylinux2014_aarch64 \
    numpy torch==2.6.0 sympy mpmath networkx jinja2 markupsafe fsspec filelock typing-extensions jaxtyping wadler-lindig beartype \
    pytest pytest-timeout pluggy iniconfig packaging pygments hypothesis sortedcontainers
  touch "$folder/packages.done"
fi

cmake -S "$root/native" -B "$folder/build" -DCMAKE_SYSTEM_NAME=Linux -DCMAKE_SYSTEM_PROCESSOR=aarch64 \
  -DCMAKE_CXX_COMPILER=aarch64-linux-gnu-g++ -DCMAKE_CXX_FLAGS="-idirafter $sysroot/usr/include" \
  -DPython_EXECUTABLE="$(command -v "$python")" -DPython_INCLUDE_DIR="$sysroot/usr/include/python3.11" -DNB_SUFFIX=.so -DNB_SUFFIX_S=.so \
  -Dnanobind_DIR="$("$python" -m nanobind --cmake_dir)" >/dev/null
cmake --build "$folder/build" --parallel "$(nproc)" >/dev/null
rm -rf "$folder/sources"
mkdir "$folder/sources"
cp -r "$root/src/." "$folder/sources/"
rm -f "$folder"/sources/gausslite/render/_kernels*.so
cp "$folder"/build/_kernels*.so "$folder/sources/gausslite/render/"

cd "$root"
[ $# -gt 0 ] || set -- tests/core/render/test_cpu_kernels.py tests/core/render/test_cpu_choices.py tests/core/render/test_cpu_bindings.py tests/contract -k "neon or test_cpu"
export PYTHONPATH=$folder/sources:$folder/packages PYTHONDONTWRITEBYTECODE=1 OMP_NUM_THREADS=1
exec qemu-aarch64-static -L "$sysroot" "$sysroot/usr/bin/python3.11" -m pytest -q -p no:cacheprovider "$@"
