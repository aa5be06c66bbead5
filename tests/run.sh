#!/usr/bin/env bash
# Everything that must hold, the quick things first and pytest last. `make test` sets up .venv and
# calls this. The Python tests run against the built wheel, installed in a place of its own.
# With CI=true in the environment nothing may be skipped for want of a program.
set -euo pipefail
cd "$(dirname "$0")/.."

DEV=.venv/bin
WHEEL=.venv-wheel/bin

main() {
    step "style" "$DEV/ruff" check .
    step "layout" "$DEV/ruff" format --check .
    step "types (mypy)" "$DEV/mypy"
    step "import contracts" "$DEV/lint-imports"
    step "generated files" "$DEV/python" spec/generate.py --check
    step "vectors and annexes" "$DEV/python" -m csplat_conformance.recipes --check
    if have node "pyright and the JavaScript tests"; then
        step "types (pyright)" "$DEV/pyright"
        if have npm "the types of the JavaScript, and SPZ's own library"; then
            step "types of the decoder (tsc)" npm run --silent --prefix codec/js types
            step "types of the viewer (tsc)" npm run --silent --prefix codec/js types -- --project ../../tools/viewer
            step "SPZ's own library" npm install --silent --no-audit --no-fund --prefix out/peers @adobe/spz@0.2.3
        fi
        step "JavaScript" javascript_tests
        if have chromium "the decoder in a browser"; then
            step "JavaScript in Chromium" node codec/js/test/browser.mjs chromium
        fi
    fi
    step "wheel" build_and_install_wheel
    step "conformance of the decoder" "$WHEEL/csplat" conformance decoder --level 4
    # Two as processes: tests/test_conformance_encoder.py takes all at every preset, in its own.
    step "conformance of the encoder" "$WHEEL/csplat" conformance encoder --level 3 --filter '*/double,*/duplicates'
    # Unguided: so few cases reach the same lines without coverage, at a third of the time. `make fuzz` is guided.
    step "fuzzing" "$WHEEL/python" tests/fuzz.py --target all --count 1500 --jobs 1 --plain
    step "Python tests" "$WHEEL/pytest" -m "not benchmark" "$@"
}

step() {
    printf '\n== %s\n' "$1"
    local began=$SECONDS
    shift
    "$@"
    printf -- '-- %d s\n' $((SECONDS - began))
}

# have PROGRAM WHAT: false, with one loud line, where WHAT must be skipped; a failure where CI=true.
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
    # shellcheck disable=SC2046  # one word per file; no name holds a space
    if ! node --test --test-reporter=spec $(find codec/js/test tools/viewer/test -name '*.test.mjs' | sort) >"$log" 2>&1; then
        sed -n '/failing tests/,$p' "$log"
        return 1
    fi
    grep -E '(tests|pass|fail|skipped) [0-9]+' "$log"
}

build_and_install_wheel() {
    rm -rf out/dist
    "$DEV/python" -m build --wheel --outdir out/dist . >out/build.log 2>&1 || {
        cat out/build.log
        return 1
    }
    [ -x "$WHEEL/python" ] || "$DEV/python" -m venv --without-pip .venv-wheel
    # Modules are compiled when they are imported: of torch alone there are thousands that never are.
    local pip=("$DEV/python" -m pip --python "$WHEEL/python" install --quiet --disable-pip-version-check --no-compile)
    local wheel
    wheel=$(echo out/dist/csplat-*.whl)
    "${pip[@]}" "${wheel}[render,film,scale,torch-tests,remote-tests,browser-tests]" pytest hypothesis jsonschema
    "${pip[@]}" --force-reinstall --no-deps "$wheel"
    "$WHEEL/python" -c 'import csplat; print("testing", csplat.__file__); assert ".venv-wheel" in csplat.__file__'
}

# Many tests start processes of their own: what one of them has compiled the next one takes.
unset PYTHONDONTWRITEBYTECODE

mkdir -p out
main "$@"
