# Wayside: two commands do everything on a fresh machine, `make demo` and `make test`.
# They need Python 3.11 to 3.13 and make; the tests of the cluster side also build a control plane (see docs/).

# The first of these that runs and is of a version that our dependencies have wheels for.
FITS := -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))'
PYTHON ?= $(shell for each in python3 python3.13 python3.12 python3.11; do $$each $(FITS) 2>/dev/null && echo $$each && break; done)
VENV ?= .venv
BIN := $(VENV)/bin

.PHONY: help demo demo-cluster test unit cluster lint bench crds clean

help: ## what can be made
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 16

# The environment follows pyproject.toml. The stamp is written last, so an installation that was cut off starts again.
$(BIN)/.installed: pyproject.toml
	@$(or $(PYTHON),false) $(FITS) || \
	  { echo "Wayside needs Python 3.11, 3.12 or 3.13, and finds none: make PYTHON=/path/to/python3.12"; exit 1; }
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	@echo "installing Wayside into $(VENV)"
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable .
	@touch $@

$(BIN)/.installed-dev: $(BIN)/.installed
	@echo "installing what the tests need"
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[dev]'
	@touch $@

demo: $(BIN)/.installed ## the main job: vehicles, events, tasks and what would run, without a cluster
	@$(BIN)/python examples/cooperative-recording/demo.py --output out

demo-cluster: $(BIN)/.installed-dev ## the same against a real control plane; CONTEXT=current: that of the current kubeconfig
	@$(BIN)/python examples/cooperative-recording/demo_cluster.py --output out $(if $(filter current,$(CONTEXT)),--current)

test: lint unit cluster ## everything that CI runs

lint: $(BIN)/.installed-dev ## style, types and the direction of the imports
	@$(BIN)/ruff check . && $(BIN)/ruff format --check --quiet . && $(BIN)/mypy && $(BIN)/lint-imports

unit: $(BIN)/.installed-dev ## the tests that need no cluster
	@$(BIN)/python -m tests.mongodb
	@$(BIN)/python -m pytest tests/unit

cluster: $(BIN)/.installed-dev ## the tests against a real control plane; builds it first where it is missing
	@$(BIN)/python -m tests.cluster.binaries
	@$(BIN)/python -m tests.helm
	@$(BIN)/python -m pytest tests/cluster

bench: $(BIN)/.installed-dev ## the benchmarks: each prints a ratio to its baseline
	@for each in $(basename $(notdir $(wildcard benchmarks/*.py))); do echo "== $$each"; $(BIN)/python -m benchmarks.$$each || exit 1; done

crds: $(BIN)/.installed ## write crds/ anew from the models
	@$(BIN)/python -m wayside.api crds

clean: ## remove what was made here; the caches outside the tree stay
	rm -rf $(VENV) out build dist *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
