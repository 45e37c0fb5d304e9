#!/usr/bin/env bash
# The kernels under AddressSanitizer and UndefinedBehaviorSanitizer: their tests, and random input for every binding.
# The thread pool under ThreadSanitizer, in a program without Python. Takes minutes; needs g++, cmake and ninja or make.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/../.."
build=build/sanitize
mkdir -p "$build"

echo "Thread pool: ThreadSanitizer"
g++ -std=c++17 -O1 -g -fsanitize=thread -Inative tests/robustness/thread_pool.cpp native/parallel.cpp -pthread -o "$build/thread_pool"
"$build/thread_pool"

echo "Kernels: AddressSanitizer and UndefinedBehaviorSanitizer"
flags="-fsanitize=address,undefined -fno-sanitize-recover=undefined -fno-omit-frame-pointer -g -O1"
cmake -S . -B "$build/cmake" -DCMAKE_BUILD_TYPE=RelWithDebInfo -DCMAKE_CXX_FLAGS="$flags" -DPOLARGUIDE_OPTIMIZE=-O1 -DPython_EXECUTABLE="$(command -v python)" >/dev/null
cmake --build "$build/cmake" -j "${JOBS:-$(nproc)}" >/dev/null
rm -rf "$build/src"
cp -r src "$build/src"
rm -f "$build"/src/polarguide/_native*.so
cp "$build"/cmake/_native*.so "$build/src/polarguide/"
export PYTHONPATH="$PWD/$build/src" OMP_NUM_THREADS=1 PYTHONMALLOC=malloc
export ASAN_OPTIONS=detect_leaks=0:allocator_may_return_null=1 UBSAN_OPTIONS=print_stacktrace=1:halt_on_error=1
LD_PRELOAD="$(g++ -print-file-name=libasan.so) $(g++ -print-file-name=libubsan.so) $(g++ -print-file-name=libstdc++.so)"
export LD_PRELOAD
python tests/robustness/bindings.py --rounds "${ROUNDS:-300}"
python -m pytest -n 0 -q -p no:cacheprovider tests/native tests/raster -m "not slow and not gpu and not shared" \
  --deselect tests/native/test_cross_compilation.py
echo "sanitizers are silent"
