#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# The tiers of tests; `make lint`, `make check`, `make test` and so on set up .venv and call this.
#
#   tests/run.sh lint    style, types, import contracts, generated files; these depend on the versions of their tools
#   tests/run.sh check   the checkout: the same of Python, and unmarked tests; half a minute
#   tests/run.sh test    the built wheel: everything that an ordinary change can break; minutes
#   tests/run.sh lab     the laboratories: authoring, planted faults, fuzzing, benchmarks
#   tests/run.sh part M  the tests with marker M
#   tests/run.sh all     all of these, with every marker, pyright and long fuzzing
#
# Further words go to pytest. With CI=true in the environment nothing may be skipped because a program is absent.
# A step that fails stops no other one. Each prints its seconds of wall time and of CPU time, children included; a table
# at the end repeats them, and says what failed.
set -euo pipefail
cd "$(dirname "$0")/.."

BIN=$PWD/.venv/bin
[ -d "$BIN" ] || BIN=$PWD/.venv/Scripts # Windows
WHEEL=out/wheel
TIER=${1:-test}
shift || true

PYTEST=("$BIN/python" -m pytest -q -n auto --dist loadfile --no-loadscope-reorder)
# CONTRIBUTING.md has a table of what each marker guards.
EVERYDAY="not (browser or engines or peers or torch or gpu or remote or long)"

# Two processes, each of which collects and imports half of the tests: workers would collect all of them twice.
check_tier() {
    local words=(-m pytest -q -n 0 --maxfail 25 -m "$EVERYDAY and not slow and not shared_data" "$@")
    background "unmarked tests, codec and suite" "$BIN/python" "${words[@]}" tests/csplat tests/csplat_conformance
    static_checks
    step "unmarked tests, others" "$BIN/python" "${words[@]}" tests/csplat_render tests/csplat_trainer tests/csplat_tools tests/system
    joined
}

# test_tier EXPRESSION [WORDS...]: EXPRESSION selects tests by their markers.
test_tier() {
    step "wheel" build_wheel
    [ -z "$FAILED" ] || finish
    use_wheel
    # Meanwhile other steps use the other core.
    background "behaviour snapshot" "$BIN/python" -m pytest -q tests/system/test_behaviour.py -m "$1"
    step "vectors equal their recipes" "$BIN/python" -m csplat_authoring --check
    ! have node "the JavaScript tests" || step "JavaScript" javascript_tests
    # By the command, as an author of a decoder or encoder runs it; tests run every level and input in their own process.
    step "conformance of the decoder" "$BIN/csplat" conformance decoder --level 4
    step "conformance of the encoder" "$BIN/csplat" conformance encoder --level 3 --filter '*/duplicates'
    joined
    step "Python tests" "${PYTEST[@]}" -m "$1" --deselect tests/system/test_behaviour.py "${@:2}"
}

# lab_tier N [WORDS...]: fuzz each target with N cases, without coverage, which would triple their time.
lab_tier() {
    step "fuzzing" "$BIN/python" conformance/lab/fuzz.py --target all --count "$1" --jobs 1 --plain
    step "tests of the laboratories" "${PYTEST[@]}" conformance/lab/tests tools/lab/tests "${@:2}"
}

all_tier() {
    step "types (pyright)" "$BIN/pyright"
    static_checks
    javascript_checks
    test_tier "" "$@"
    lab_tier 1500
}

static_checks() {
    step "style" "$BIN/ruff" check .
    step "layout" "$BIN/ruff" format --check .
    step "types (mypy)" "$BIN/mypy"
    step "import contracts" "$BIN/lint-imports"
    step "generated files" "$BIN/python" spec/generate.py --check
}

javascript_checks() {
    have npm "types and layout of the JavaScript" || return 0
    [ node_modules/.package-lock.json -nt package-lock.json ] ||
        step "npm packages" npm ci --silent --no-audit --no-fund --ignore-scripts
    step "types (tsc)" npm run --silent types
    step "layout (prettier)" npm run --silent format:check
}

SUMMARY=""
FAILED=""

# step NAME COMMAND...: run it in a subshell, whose CPU time is that of this step alone, even while others run.
step() {
    local status=0
    printf '\n== %s\n' "$1"
    (timed out/step.seconds "${@:2}") || status=$?
    noted "$1" out/step.seconds $status
}

# timed FILE COMMAND...: write the seconds of wall and of CPU time that a command took; for a subshell of its own.
timed() {
    local began=$SECONDS status=0
    "${@:2}" || status=$?
    cpu_seconds
    echo "$((SECONDS - began)) $CPU" >"$1"
    return $status
}

# noted NAME FILE STATUS: print the seconds of a step, and keep them and its failure for the end.
noted() {
    local wall cpu
    read -r wall cpu <"$2"
    printf -- '-- %d s, CPU %d s\n' "$wall" "$cpu"
    SUMMARY+=$(printf '%-28s %5d %5d' "$1" "$wall" "$cpu")$'\n'
    [ "$3" = 0 ] || FAILED+="  $1"$'\n'
}

# Print the table, and exit with status 1 if a step failed.
finish() {
    cpu_seconds
    printf '\n%-28s %5s %5s\n%s%-28s %5d %5d\n' step wall CPU "$SUMMARY" "$TIER" $((SECONDS - BEGAN)) "$CPU"
    [ -z "$FAILED" ] || { printf '\nfailed:\n%s' "$FAILED" && exit 1; }
    exit 0
}

# Set CPU to the CPU seconds of this shell and of all its children that have ended.
cpu_seconds() {
    local file=out/times.$BASHPID
    times >"$file"
    CPU=$(awk -F'[ms ]+' '{ total += 60 * $1 + $2 + 60 * $3 + $4 } END { printf "%d", total + 0.5 }' "$file")
    rm "$file"
}

# background NAME COMMAND...: run a step in parallel to the following ones; `joined` waits for it and prints its output.
background() {
    BACKGROUND_NAME=$1
    (timed out/background.seconds "${@:2}") >out/background.log 2>&1 &
    BACKGROUND=$!
}

joined() {
    local status=0
    wait "$BACKGROUND" || status=$?
    printf '\n== %s\n' "$BACKGROUND_NAME"
    cat out/background.log
    noted "$BACKGROUND_NAME" out/background.seconds $status
}

# have PROGRAM WHAT: false, with one loud line, if WHAT must be skipped; a failure if CI=true.
have() {
    command -v "$1" >/dev/null && return 0
    printf '\n==== SKIPPED: %s, because %s is not installed ====\n' "$2" "$1"
    if [ "${CI:-}" = true ]; then
        echo "CI=true: a skip is a failure" >&2
        exit 1
    fi
    return 1
}

# The counts when all is well, every failure in full otherwise.
javascript_tests() {
    local log=out/javascript.log
    if ! node --test-reporter=spec codec/js/test/all.mjs >"$log" 2>&1; then
        sed -n '/failing tests/,$p' "$log"
        return 1
    fi
    grep -E '(tests|pass|fail|skipped) [0-9]+' "$log"
}

build_wheel() {
    rm -rf out/dist
    CSPLAT_NATIVE=${CSPLAT_NATIVE:-require} "$BIN/python" -m build --wheel --no-isolation --outdir out/dist . \
        >out/build.log 2>&1 || {
        cat out/build.log
        return 1
    }
}

# The wheel's files go before the checkout on the path of every process: what is tested is what users install.
use_wheel() {
    "$BIN/python" tests/helpers/wheel.py out/dist/csplat-*.whl "$WHEEL"
    export PYTHONPATH=$PWD/$WHEEL${PYTHONPATH:+:$PYTHONPATH}
    "$BIN/python" -c 'import csplat; print("testing", csplat.__file__); assert "wheel" in csplat.__file__'
}

unset PYTHONDONTWRITEBYTECODE # many tests start processes: what one of them has compiled the next one takes

mkdir -p out
BEGAN=$SECONDS
case $TIER in
lint) static_checks && javascript_checks ;;
check) check_tier "$@" ;;
test) test_tier "$EVERYDAY" "$@" ;;
lab) lab_tier 200 "$@" ;;
part) step "marker $1" "${PYTEST[@]}" -m "$1" "${@:2}" ;;
all) all_tier "$@" ;;
*)
    echo "usage: tests/run.sh lint|check|test|lab|part|all [words for pytest]" >&2
    exit 2
    ;;
esac
finish
