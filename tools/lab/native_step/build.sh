#!/bin/sh
# Builds libcsplat_refit_SET.so for each instruction set: build.sh [FOLDER [COMPILER [avx2|avx512]…]]
# Default: out/native_step/COMPILER, c++, both sets.
set -eu
sources=$(dirname "$0")
cxx=${2:-c++}
folder=${1:-$sources/../../../out/native_step/$(basename "$cxx")}
[ $# -gt 2 ] || set -- "$folder" "$cxx" avx2 avx512
shift 2
flags="-std=c++17 -O3 -ffp-contract=off -fno-math-errno -fPIC -shared -pthread -Wall -Wextra -Wno-uninitialized"
mkdir -p "$folder"
for set in "$@"; do
    case $set in
    avx2) target="-mavx2 -mfma" ;;
    avx512) target="-march=x86-64-v4" ;;
    *) echo "the instruction set is $set, expected avx2 or avx512" >&2 && exit 2 ;;
    esac
    library=$folder/libcsplat_refit_$set.so
    # $flags and $target are lists. A process that loads the library meanwhile finds the old one or the new one.
    $cxx $flags $target "$sources"/*.cpp -o "$library.$$"
    mv "$library.$$" "$library"
done
