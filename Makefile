# make serve   sets everything up and serves (HTTP 8000, gRPC 50051) in the foreground
# make test    sets everything up and runs the tests
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# A file of tests belongs to one process, which shares its services among them. Most of the time they wait for others: four fit two cores.
PYTEST := $(BIN)/pytest --numprocesses 4 --dist loadfile
KERNEL_SOURCES := $(wildcard model/kernels/*) CMakeLists.txt
PACKAGES := . proto client
PACKAGE_SOURCES := $(KERNEL_SOURCES) $(PACKAGES:%=%/pyproject.toml) $(wildcard distribution/*.py)
PIP_INSTALL := $(BIN)/python -m pip install --quiet --disable-pip-version-check
GENERATED_TESTS := tests/proto tests/client/test_client_generated.py tests/interfaces/test_generated_tables.py tests/interfaces/test_measured_tables.py tests/service/test_snapshots.py
PYTHON_SOURCES := model service workers proto client distribution tests benchmarks docs examples
NPM := $(shell command -v npm)
CONSOLE := service/ultragray_service/console/index.html
CONSOLE_SOURCES := $(shell find web -type f -not -path 'web/node_modules/*' -not -path 'web/src/api/generated/*')
CONSOLE_IF_POSSIBLE = [ -z "$(NPM)" ] || $(MAKE) --no-print-directory console || echo "The console could not be built; all else works without it."
DATA ?= ../shared/data
ARGS ?=
MINUTES ?= 30

.DEFAULT_GOAL := help
.PHONY: ALWAYS help serve console test test-fast test-long test-console test-faults test-fuzz test-soak test-overload check check-lint check-types check-generated check-web format bench bench-console console-picture bench-cuda results ablations poses demo-scene generate packages clean

help:  ## say what there is
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed 's/:.*## /\t/' | expand -t 14

serve: $(VENV)/installed  ## set up, then serve the demo scene and every *.ugr in ./data (ARGS="--help" for options)
	@$(CONSOLE_IF_POSSIBLE)
	@exec $(BIN)/ultragray serve $(ARGS)

console: $(CONSOLE)  ## build the console, which the service serves at / (needs Node 20 or newer; serve does it where that is there)

test: $(VENV)/installed-dev  ## set up, then run the tests in random order (ARGS="-k probe" for some, ARGS="--randomly-seed=N" for an order again)
	@$(CONSOLE_IF_POSSIBLE)
	$(PYTEST) -m "not long" $(ARGS)

test-fast: $(VENV)/installed-dev  ## those that take a minute together, for while one works: without processes of their own
	$(PYTEST) -m "not slow and not long" $(ARGS)

test-long: $(VENV)/installed-dev  ## those that make test leaves out; what came of it goes to tests/long-run.json
	@$(CONSOLE_IF_POSSIBLE)
	$(PYTEST) -m long --record-in tests/long-run.json $(ARGS)

test-console: $(VENV)/installed-dev $(CONSOLE)  ## the console in Debian's Chromium against a real service; leaves screenshots in build
	node --test --test-concurrency=1 tests/console/*.test.mjs

test-faults: $(VENV)/installed-dev  ## processes killed at random: render workers under load, then everything while jobs run
	ULTRAGRAY_FAULT_SECONDS=30 $(BIN)/pytest tests/workers/pool/test_faults.py -s $(ARGS)
	ULTRAGRAY_FAULT_KILLS=32 $(BIN)/pytest tests/faults -s $(ARGS)

test-fuzz: $(VENV)/installed-dev  ## 100,000 inputs that are nearly right, on every door and in every file format (ARGS="--seed N" for the same again)
	ULTRAGRAY_FUZZ_INPUTS=100000 $(BIN)/pytest --numprocesses 2 --dist loadfile tests/fuzz $(ARGS)

test-soak: $(VENV)/installed-dev  ## clients of all kinds for MINUTES (30) while processes are killed; the result goes to tests/soak-run.json
	ULTRAGRAY_SOAK_SECONDS=$$(($(MINUTES) * 60)) ULTRAGRAY_SOAK_RECORD=tests/soak-run.json $(BIN)/pytest tests/soak $(ARGS)

test-overload: $(VENV)/installed-dev  ## ten times the capacity for a minute at each door; the figures go to tests/overload-run.json
	@rm -f tests/overload-run.json
	ULTRAGRAY_OVERLOAD_SECONDS=60 ULTRAGRAY_OVERLOAD_RECORD=tests/overload-run.json $(BIN)/pytest tests/overload $(ARGS)

check: $(VENV)/installed-dev  ## lint, types, formatting, and whether what is generated is current; all at the same time
	@$(MAKE) --no-print-directory --keep-going --jobs --output-sync=target check-lint check-types check-generated check-web

check-lint:
	$(BIN)/ruff check $(PYTHON_SOURCES)
	$(BIN)/ruff format --check $(PYTHON_SOURCES)
	$(BIN)/clang-format --dry-run --Werror model/kernels/*.[ch]pp model/kernels/*.inl
	$(BIN)/hadolint docker/Dockerfile.cpu docker/Dockerfile.cuda

check-types:
	$(BIN)/mypy

check-generated:
	$(BIN)/pytest --quiet $(GENERATED_TESTS)

check-web:
	@$(CONSOLE_IF_POSSIBLE)
	@[ ! -d web/node_modules ] || npm --prefix web run --silent check

format: $(VENV)/installed-dev  ## rewrite the sources in the project's format
	$(BIN)/ruff check --fix $(PYTHON_SOURCES)
	$(BIN)/ruff format $(PYTHON_SOURCES)
	$(BIN)/clang-format -i model/kernels/*.[ch]pp model/kernels/*.inl

bench: $(VENV)/installed  ## measure the kernel and the service; the table is printed, the JSON written
	$(BIN)/ultragray bench --output benchmarks/results.json $(ARGS)
	$(BIN)/ultragray bench --kernel-details --output benchmarks/kernel.json $(ARGS)
	$(BIN)/ultragray bench --train --output benchmarks/training.json $(ARGS)
	$(BIN)/ultragray bench --jobs --output benchmarks/jobs.json $(ARGS)
	$(BIN)/ultragray bench --clients --output benchmarks/clients.json $(ARGS)
	$(BIN)/python benchmarks/performance.py

bench-console: $(VENV)/installed-dev $(CONSOLE)  ## frames a second, memory and first paint of the console in Debian's Chromium; takes six minutes
	node tests/console/measure.mjs > build/console.json
	mv build/console.json benchmarks/console.json

console-picture: $(VENV)/installed-dev $(CONSOLE)  ## take the README's picture of the console
	node tests/console/picture.mjs

bench-cuda: $(VENV)/installed  ## the same on a GPU, with the distance to what it can do at most
	$(BIN)/ultragray bench --backend cuda --output benchmarks/cuda.json $(ARGS)
	$(BIN)/ultragray bench --backend cuda --train --output benchmarks/cuda_training.json $(ARGS)

results: $(VENV)/installed  ## train on every data set of DATA and write docs/results.md (ARGS="--only liver_convex" for one)
	$(BIN)/python benchmarks/results_tables.py $(DATA) $(ARGS)

ablations: $(VENV)/installed  ## train without each part of the training, three seeds each, and write docs/results.md; takes an hour
	$(BIN)/python benchmarks/ablations.py $(DATA) $(ARGS)
	$(BIN)/python benchmarks/results_tables.py $(DATA) --only

poses: $(VENV)/installed  ## train with errors added to poses, with and without refinement, and write docs/poses.md; takes half an hour
	$(BIN)/python benchmarks/poses.py $(DATA) $(ARGS)

demo-scene: $(VENV)/installed  ## simulate the phantom, train the demo scene from it and put it in its place
	$(BIN)/python -m ultragray.demo.make

generate: $(VENV)/installed-dev  ## rewrite what is generated: the gRPC stubs, most of the client, tables of the documents
	$(BIN)/python proto/generate.py
	$(BIN)/python client/generate.py
	$(BIN)/python docs/generate.py

packages: $(VENV)/installed-dev $(CONSOLE)  ## build the three packages into dist: sdists, and wheels for this Python
	for package in $(PACKAGES); do $(BIN)/python -m build --outdir dist $$package || exit 1; done

clean:  ## remove what was built
	rm -rf $(VENV) build dist web/node_modules $(dir $(CONSOLE))

# Made once, by the PYTHON of that time: another one over it would mix the two.
$(VENV)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "error: Python 3.11 or newer is needed, and $(PYTHON) is not; choose one with: make PYTHON=/path/to/python3"; exit 1; }
	@$(PYTHON) -c 'import venv; from ensurepip import bootstrap' 2> /dev/null || \
		{ echo "error: $(PYTHON) cannot make virtual environments; on Debian: sudo apt-get install python3-venv"; exit 1; }
	@echo "Creating the virtual environment in $(VENV) ..."
	@$(PYTHON) -m venv $(VENV)
	@touch $@

# An editable install knows each module by its file: one that moved is found again after another install.
$(VENV)/modules: ALWAYS | $(VENV)/python
	@find model workers service proto client -name '*.py' | sort > $@.new
	@cmp --quiet $@.new $@ && rm $@.new || mv $@.new $@

$(VENV)/installed: $(VENV)/python $(VENV)/modules $(PACKAGE_SOURCES)
	@$(BIN)/python distribution/prerequisites.py
	@echo "Installing the libraries and compiling the kernel (a minute or two the first time) ..."
	@$(PIP_INSTALL) --editable ./proto --editable '.[all]' --editable ./client || \
		{ echo "error: pip said above why it failed; if it found no cmake or ninja: sudo apt-get install cmake ninja-build"; exit 1; }
	@touch $@

$(VENV)/installed-dev: $(VENV)/installed
	@echo "Installing the test and lint tools ..."
	@$(PIP_INSTALL) 'ultragray[dev]'
	@touch $@

web/node_modules/.package-lock.json: web/package-lock.json
	@[ -n "$(NPM)" ] || { echo "The console needs Node 20 or newer, with npm"; exit 1; }
	@echo "Installing what the console is built with ..."
	@npm --prefix web ci --silent --no-audit --no-fund
	@touch $@

$(CONSOLE): web/node_modules/.package-lock.json $(CONSOLE_SOURCES)
	@npm --prefix web run --silent build
	@touch $@
