# Wayside: two commands do everything on a fresh machine, `make demo` and `make test`.
# They need Python 3.11 to 3.13 and make; the cluster tests also build a control plane (see docs/).

# The first of these that runs and has a version for which our dependencies have wheels.
FITS := -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))'
PYTHON ?= $(shell for each in python3 python3.13 python3.12 python3.11; do $$each $(FITS) 2>/dev/null && echo $$each && break; done)
VENV ?= .venv
BIN := $(VENV)/bin

# Hundreds of tests start programs: compiling them each time would double the time of the tests.
unexport PYTHONDONTWRITEBYTECODE

# Tests that wait on other processes: two a core. Three leave too little time for those processes.
WAITING := $(BIN)/python -m pytest -n 4 --dist loadgroup

.PHONY: help demo demo-cluster tutorial examples test unit process cluster compat e2e lint bench load mutants soak requirements wheels image crds clean

help: ## list the targets
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 16

# The environment follows pyproject.toml. The stamp is written last, so an interrupted installation starts again.
$(BIN)/.installed: pyproject.toml
	@$(or $(PYTHON),false) $(FITS) || \
	  { echo "Wayside needs Python 3.11, 3.12 or 3.13, and finds none: make PYTHON=/path/to/python3.12"; exit 1; }
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	@echo "installing Wayside into $(VENV)"
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[results]'
	@touch $@

$(BIN)/.installed-dev: $(BIN)/.installed
	@echo "installing what the tests need"
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[dev]'
	@touch $@

demo: $(BIN)/.installed ## the main job: vehicles, events, tasks and the resulting objects, without a cluster
	@$(BIN)/python examples/cooperative-recording/demo.py --output out

demo-cluster: $(BIN)/.installed-dev ## the same against a real control plane; CONTEXT=current: that of the current kubeconfig
	@$(BIN)/python examples/cooperative-recording/demo_cluster.py --output out $(if $(filter current,$(CONTEXT)),--current)

tutorial: $(BIN)/.installed-dev ## the run described in docs/tutorial.md, step by step
	@$(BIN)/python examples/cooperative-recording/tutorial.py --pause

examples: $(BIN)/.installed-dev ## all use cases: expected and actual events and actions, without a cluster
	@$(BIN)/python -m examples.running --output out/examples

# Programs for the tests are built beside lint and unit tests, which need none; then the waiting tests run in parallel.
test: $(BIN)/.installed-dev ## everything that CI runs
	@mkdir -p out; $(BIN)/python -m tests.builds >out/builds.log 2>&1 & \
	trap "kill $$! 2>/dev/null" EXIT; $(MAKE) --no-print-directory lint unit && \
	{ wait $$! || { cat out/builds.log; exit 1; }; } && $(WAITING) tests/process tests/cluster tests/e2e

lint: $(BIN)/.installed-dev ## style, words, types and the direction of the imports
	@$(BIN)/ruff check . && $(BIN)/python -m tests.prose && $(BIN)/ruff format --check --quiet . && $(BIN)/mypy && $(BIN)/lint-imports

unit: $(BIN)/.installed-dev ## the tests of pure code and of files
	@$(BIN)/python -m pytest tests/unit -n 2 --dist worksteal

process: $(BIN)/.installed-dev ## the tests with a detector's processes, Zenoh, MQTT, HTTP and a database's server
	@$(BIN)/python -m tests.mongodb
	@$(BIN)/python -m tests.s3
	@$(BIN)/python -m tests.helm
	@$(WAITING) tests/process

cluster: $(BIN)/.installed-dev ## the tests against a real control plane; builds it first where it is missing
	@$(BIN)/python -m tests.cluster.binaries
	@$(BIN)/python -m tests.helm
	@$(BIN)/python -m tests.kstatus
	@$(WAITING) tests/cluster

compat: $(BIN)/.installed-dev ## the tests of the cluster on the oldest Kubernetes that is supported; builds it first where it is missing
	@WAYSIDE_TEST_KUBERNETES=oldest $(BIN)/python -m tests.cluster.binaries
	@$(BIN)/python -m tests.helm
	@$(BIN)/python -m tests.kstatus
	@WAYSIDE_TEST_KUBERNETES=oldest $(WAITING) tests/cluster

e2e: $(BIN)/.installed-dev ## the tests on a real node with containers, as root; builds it first where it is missing
	@$(BIN)/python -m tests.cluster.binaries
	@$(BIN)/python -m tests.helm
	@$(BIN)/python -m tests.e2e.programs
	@$(WAITING) tests/e2e

bench: $(BIN)/.installed-dev ## run the benchmarks: each prints a ratio to its baseline
	@for each in $(basename $(notdir $(wildcard benchmarks/*.py))); do echo "== $$each"; $(BIN)/python -m benchmarks.$$each || exit 1; done

mutants: $(BIN)/.installed-dev ## mutation tests: for each small wrong change, a test must fail
	@$(BIN)/python -m tests.mutants

load: $(BIN)/.installed-dev ## attacks on the manager from one namespace, while a task of another is measured
	@$(BIN)/python -m benchmarks.attacks.load --unserved; $(BIN)/python -m benchmarks.attacks.load

soak: $(BIN)/.installed-dev ## an hour of traffic, faster than it happens: nothing grows, every loss is counted
	@$(BIN)/python -m benchmarks.soak

crds: $(BIN)/.installed ## regenerate crds/ from the models, and the generated parts of the chart and of docs/
	@$(BIN)/python -m wayside.api crds
	@$(BIN)/python -m wayside.expressions docs
	@$(BIN)/python -m charts.generate

requirements: $(BIN)/.installed-dev ## pin the image's packages to the newest versions that pyproject.toml allows
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check uv
	@echo 'setuptools>=77' | $(BIN)/uv pip compile pyproject.toml - --extra etsi --extra mqtt --extra otel --upgrade \
	  --generate-hashes --universal --python-version 3.11 --no-header --no-annotate --quiet -o docker/requirements.txt
	@echo 'setuptools>=77' | $(BIN)/uv pip compile pyproject.toml - --extra etsi --extra mqtt --extra otel --extra onnx \
	  --extra mining --extra protobuf --extra results --constraint docker/requirements.txt --generate-hashes --universal \
	  --python-version 3.11 --no-header --no-annotate --quiet -o docker/requirements-full.txt

wheels: $(BIN)/.installed-dev ## check that the images' packages exist as wheels for both architectures, and print their sizes
	@$(BIN)/python docker/wheels.py

image: $(BIN)/.installed-dev ## build the Dockerfile with buildah, as root and without Docker, and print the compressed size
	@$(BIN)/python docker/image.py

clean: ## remove build results; the caches outside the tree stay
	rm -rf $(VENV) out build dist *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache benchmarks/peers/*/target
