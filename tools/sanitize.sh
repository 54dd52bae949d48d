#!/usr/bin/env bash
# Runs the native kernels' tests under the compiler's sanitizers: tools/sanitize.sh address|thread [PYTHON] [PYTEST ARGUMENTS].
# `address` includes the undefined-behaviour sanitizer. PYTHON needs the test extra, nanobind and cmake.
set -euo pipefail
root=$(cd "$(dirname "$0")/.." && pwd)
fail() { echo "sanitize: $1" >&2; exit 1; }

kind=${1:-}
case $kind in
  # One SIMD variant besides the portable one: instrumenting all takes many minutes and finds no more errors in the stages.
  address)
    sanitizers=address,undefined runtimes="libasan.so libubsan.so" variants="avx2;neon"
    tests=(tests/core/render/test_cpu_{kernels,choices,bindings}.py tests/core/codec/test_unpack.py)
    ;;
  # The variants share the work among threads by the same code.
  thread) sanitizers=thread runtimes=libtsan.so variants=portable tests=(tests/core/render/test_cpu_{kernels,bindings}.py) ;;
  *) fail "expected address or thread, got '$kind'" ;;
esac
python=$(command -v "${2:-python3}") || fail "no such Python: ${2:-python3}"
python=$("$python" -c 'import sys; print(sys.executable)')
shift $(($# < 2 ? $# : 2))
compiler=${CXX:-g++}

# The runtime must be loaded before Python, with libstdc++, whose exceptions it intercepts.
preload=
for library in $runtimes libstdc++.so; do
  path=$("$compiler" -print-file-name="$library" 2>/dev/null) || fail "no compiler $compiler"
  [ -e "$path" ] || fail "$compiler has no $library here; nothing was checked"
  preload=$preload${preload:+:}$(readlink -f "$path")
done

# The thread sanitizer's shadow memory has fixed addresses, which collide with wide address space randomisation.
no_randomisation=()
if [ "$kind" = thread ]; then
  no_randomisation=(setarch "$(uname -m)" -R)
  "${no_randomisation[@]}" true 2>/dev/null || no_randomisation=()
fi
export ASAN_OPTIONS=detect_leaks=0  # CPython keeps much memory until the process ends
export UBSAN_OPTIONS=print_stacktrace=1 TSAN_OPTIONS=halt_on_error=1 PYTHONMALLOC=malloc OMP_NUM_THREADS=1
run_checked() { env LD_PRELOAD="$preload" "${no_randomisation[@]}" "$python" "$@"; }
run_checked -c pass || fail "the $kind sanitizer's runtime does not start on this machine; nothing was checked"

build=$root/build/sanitize-$kind
PATH=$(dirname "$python"):$PATH
cmake -S "$root/native" -B "$build" -DGAUSSLITE_SANITIZE=$sanitizers -DGAUSSLITE_VARIANTS="$variants" \
  -DCMAKE_CXX_COMPILER="$compiler" -DPython_EXECUTABLE="$python" -Dnanobind_DIR="$("$python" -m nanobind --cmake_dir)" >/dev/null
cmake --build "$build" --parallel "$(nproc)" >/dev/null

# A copy of the package with this module: the installed package and the working tree stay unchanged.
rm -rf "$build/package"
mkdir "$build/package"
cp -r "$root/src/." "$build/package/"
rm -f "$build"/package/gausslite/{render/_kernels,codec/_unpack}*.so
cp "$build"/_kernels*.so "$build/package/gausslite/render/"
cp "$build"/_unpack*.so "$build/package/gausslite/codec/"
# An editable install would be found before PYTHONPATH, with kernels that are not instrumented.
echo 'import sys; sys.meta_path[:] = [each for each in sys.meta_path if not type(each).__module__.startswith("_editable")]' \
  > "$build/package/sitecustomize.py"
export PYTHONPATH=$build/package PYTHONDONTWRITEBYTECODE=1
cd "$root"
run_checked -c "import sys, gausslite.render._kernels as kernels; sys.exit(not kernels.__file__.startswith('$build/package'))" ||
  fail "Python does not import the instrumented kernels; nothing was checked"
[ $# -gt 0 ] || set -- "${tests[@]}"
# Uncaptured: a sanitizer writes its report and ends the process; pytest would lose the report.
run_checked -m pytest -m "" -q --capture=no -p no:cacheprovider "$@"
