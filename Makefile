# `make demo` first, `make test` second; `make help` lists the rest.
# A machine with Python 3.11 or newer is enough; everything else goes into .venv, by uv if it is installed, else by pip.

PYTHON ?= $(shell for p in python3 python3.11 python3.12 python3.13 python3.14; do \
	$$p -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && echo $$p && break; done)
VENV := .venv
BIN := $(VENV)/$(if $(filter Windows_NT,$(OS)),Scripts,bin)
UV := $(shell command -v uv)
# The system's certificates, as pip does: a network may have its own.
export UV_NATIVE_TLS ?= true
# `make test RESOLUTION=lowest-direct`: the oldest versions that pyproject.toml allows; needs uv.
RESOLUTION ?= highest
INSTALL := $(if $(UV),$(UV) pip install --quiet --resolution $(RESOLUTION) --python $(BIN)/python,$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile)
CORE = $(VENV)/.core
BENCH := $(BIN)/python -m csplat_bench
CLANG ?= $(shell command -v clang || command -v clang-14 || echo clang)
# Without the tracing of comparisons, which takes three quarters of the time and finds no more.
FUZZED := -std=c99 -g -O2 -fsanitize=fuzzer,address,undefined -fno-sanitize-recover=all -fno-sanitize-coverage=trace-cmp
SAMPLE := tools/csplat_tools/data/sample.ply
NATIVE := trainer/csplat_render/native/build.py

.DEFAULT_GOAL := help

.PHONY: help demo examples check test lab-test test-all native dist test-dist lint format spec sample docs bench wasm fuzz fuzz-c clean

help: ## this list
	@grep -E '^[a-z%-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:[^#]*## */\t/' | expand -t 12

demo: $(CORE) ## install this clone into .venv, editable; encode, verify and decode the sample scene
	@mkdir -p out
	$(BIN)/csplat encode $(SAMPLE) out/sample.csplat --force
	$(BIN)/csplat verify out/sample.csplat
	$(BIN)/csplat decode out/sample.csplat out/sample.ply --force
	$(BIN)/csplat info out/sample.csplat
	@ls -l $(SAMPLE) out/sample.csplat out/sample.ply

examples: $(VENV)/.core ## the sample scene, or SCENE=yours.csplat, in each engine; needs npm
	@mkdir -p tools/examples/public
	$(if $(SCENE),cp "$(SCENE)",$(BIN)/csplat encode --force $(SAMPLE)) tools/examples/public/scene.csplat
	$(BIN)/csplat export-element tools/examples/public/csplat-view.js --force
	cd tools/examples && npm install --silent --no-audit --no-fund && npm start

check: $(VENV)/.dev native ## half a minute: style, types, import contracts, generated files, unmarked tests, on the checkout
	tests/run.sh check

test: $(VENV)/.dev native ## everything that an ordinary change can break, on the built wheel
	tests/run.sh test

lab-test: $(VENV)/.dev native ## the laboratories: authoring, planted faults, fuzzing, benchmarks
	tests/run.sh lab

test-all: $(VENV)/.all native ## all of these with every marker: browsers, engines, peers, torch, GPU, S3, Dask, long fuzzing
	tests/run.sh all

part-lab: lab-test
part-%: $(VENV)/.all native ## the tests of one marker: make part-browser
	tests/run.sh part $*

native: | $(BIN)/python ## compile the library of the renderer, if its sources have changed
	@needed=$$($(BIN)/python $(NATIVE) --requires) && { [ -z "$$needed" ] || $(INSTALL) "$$needed"; }
	@$(BIN)/python $(NATIVE) >/dev/null

lint: $(VENV)/.dev ## style, types, import contracts and generated files, of Python and JavaScript
	tests/run.sh lint

format: $(VENV)/.dev ## bring the code into its one layout
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

spec: $(VENV)/.dev ## write constants and tables from the registry
	$(BIN)/python spec/generate.py

sample: $(VENV)/.dev native ## make the sample scene again: photograph the garden, train; some minutes
	$(BIN)/python tools/lab/sample/make_sample.py

docs: $(VENV)/.core ## the documentation, as a site in out/site
	$(INSTALL) --editable '.[docs]'
	$(BIN)/python tools/docs/make_site.py
	@echo "open out/site/index.html"

dist: $(VENV)/.dev ## sdist, wheels with and without the library, npm packages in out/; a release gives TAG and URL, for metadata
	rm -rf out/dist out/npm && mkdir -p out/npm
	$(if $(URL),$(BIN)/python tools/release/prepare.py --tag "$(TAG)" --url "$(URL)")
	CSPLAT_NATIVE=off $(BIN)/python -m build --no-isolation --outdir out/dist .
	$(if $(filter off,$(CSPLAT_NATIVE)),,CSPLAT_NATIVE=require $(BIN)/python -m build --wheel --no-isolation --outdir out/dist .)
	npm pack --silent --pack-destination out/npm ./codec/js ./codec/js-encoder

test-dist: FRESH := out/fresh/$(notdir $(BIN))
test-dist: ## install the wheel that pip chooses of out/dist in an environment of its own; run the commands of `make demo` and `compare`
	rm -rf out/fresh && $(PYTHON) -m venv out/fresh
	$(FRESH)/python -m pip download --quiet --no-index --no-deps --only-binary :all: --find-links out/dist --dest out/fresh/wheel csplat
	$(FRESH)/python -m pip install --quiet --disable-pip-version-check "$$(echo out/fresh/wheel/*.whl)[render]"
	$(MAKE) --no-print-directory demo BIN=$(FRESH) CORE=
	$(FRESH)/csplat compare $(SAMPLE) out/sample.csplat

bench: $(VENV)/.dev native ## measure what is missing in out/bench, suite by suite; a day or more
	$(BIN)/pytest tools/lab/tests
	for suite in codec formats file_parts decoder_agreement decoders targets rendering training viewer; do \
		$(BENCH) run $$suite || exit 1; \
	done

wasm: ## compile decoder and encoder in C for JavaScript; needs Debian 12's clang-14 lld-14 wasi-libc libclang-rt-14-dev-wasm32
	codec/js/wasm/build.sh codec/js/wasm_binary.mjs
	codec/js-encoder/wasm/build.sh codec/js-encoder/wasm_binary.mjs

fuzz: $(VENV)/.dev ## forty minutes of malformed files: decoders, validator, readers
	$(BIN)/python conformance/lab/fuzz.py --target all --seconds 2400

fuzz-c: $(VENV)/.core ## ten minutes of the same for the decoder in C, and what it finds for the others; needs clang
	@mkdir -p out/fuzz/c/corpus
	$(CLANG) $(FUZZED) -DCSPLAT_NO_ZLIB codec/c/fuzz/fuzz.c codec/c/inflate.c -lm -o out/fuzz/c/fuzz
	out/fuzz/c/fuzz -max_total_time=600 -max_len=16000 -timeout=10 -artifact_prefix=out/fuzz/c/ out/fuzz/c/corpus \
		$(wildcard conformance/csplat_conformance/vectors/*/)
	@mkdir -p out/fuzz/inflate
	$(CLANG) $(FUZZED) codec/c/fuzz/inflate.c -lz -o out/fuzz/inflate/fuzz
	out/fuzz/inflate/fuzz -max_total_time=120 -max_len=2000 -artifact_prefix=out/fuzz/inflate/
	$(BIN)/python conformance/lab/fuzz.py --target others --replay out/fuzz/c/corpus
	@mkdir -p out/fuzz/encode/corpus
	$(CLANG) $(FUZZED) -DCSPLAT_NO_ZLIB codec/c/fuzz/encode.c $(filter-out codec/c/example.c,$(wildcard codec/c/*.c)) -lm \
		-o out/fuzz/encode/fuzz
	out/fuzz/encode/fuzz -max_total_time=60 -max_len=3000 -artifact_prefix=out/fuzz/encode/ out/fuzz/encode/corpus

clean: ## remove what the commands above made
	rm -rf $(VENV) out dist build .mypy_cache .ruff_cache .pytest_cache .hypothesis \
		.import_linter_cache trainer/csplat_render/native/csplat_native*
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(BIN)/python:
	@test -n "$(PYTHON)" || { echo "csplat needs Python 3.11 or newer" >&2; exit 1; }
	@test -n "$(UV)" -o "$(RESOLUTION)" = highest || { echo "RESOLUTION=$(RESOLUTION) needs uv" >&2; exit 1; }
	$(if $(UV),$(UV) venv --quiet --seed --python $(PYTHON) $(VENV),$(PYTHON) -m venv $(VENV))

$(VENV)/.core: pyproject.toml | $(BIN)/python
	$(INSTALL) --editable .
	@touch $@

$(VENV)/.dev: pyproject.toml | $(BIN)/python
	$(INSTALL) --editable '.[dev]'
	@touch $(VENV)/.core $@

# By pip: uv would take a build of torch for CUDA, several gigabytes.
$(VENV)/.all: pyproject.toml | $(BIN)/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile --editable '.[all-tests]'
	@touch $(VENV)/.core $(VENV)/.dev $@
