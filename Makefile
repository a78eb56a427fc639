# Everything from one virtual environment made here; needs python3.11 and make, nothing else.
#
#   make demo       install, then watch a simulated robot learn; Ctrl-C stops, again continues
#   make test       install, then all checks and tests but the slow ones
#
# Variables: PYTHON (python3.11), ARGS (more options: for `corridor up` in demo, of mutants,
# extras-test and bench-peers), and TORCH_INDEX_URL: one of PyTorch's own package indexes, to choose a CPU-only or a
# CUDA build.

PYTHON ?= python3.11
TORCH_INDEX_URL ?=
ARGS ?=
VENV := .venv
PEERS := .venv-peers
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check
# Tests run beside each other: more than one thread each would only get in the way.
PYTEST := OMP_NUM_THREADS=1 $(BIN)/python -m pytest
BESIDE := -n 4 --dist worksteal

.DEFAULT_GOAL := help
.PHONY: help setup demo test test-full check lint unit system mutants compose-test extras-test page-test docs bench profile bench-full bench-peers peers-test clean
.DELETE_ON_ERROR:
.NOTPARALLEL:

help: ## show this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-12s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

setup: $(VENV)/.dev ## make the virtual environment with everything in it

demo: $(VENV)/.all ## install what is needed, then run the demo until Ctrl-C
	@$(BIN)/corridor up --preset demo $(ARGS)

# Four at a time: most tests that take long wait for something.
test: $(VENV)/.dev ## all checks and tests but the slow ones
	$(PYTEST) $(BESIDE) -m "not slow" tests

test-full: $(VENV)/.dev ## all checks and tests
	$(PYTEST) -n 2 tests/unit tests/repository tests/contract
	$(PYTEST) tests/system tests/learning

check: $(VENV)/.dev ## style, types, dependency rules
	$(BIN)/python -m tests.checks

lint: $(VENV)/.dev ## style only
	$(BIN)/python -m tests.checks --style

unit: $(VENV)/.dev ## fast tests
	$(PYTEST) $(BESIDE) -m "not slow" tests/unit tests/repository tests/contract

system: $(VENV)/.dev ## tests with real processes and a real router, without the slow ones
	$(PYTEST) $(BESIDE) -m "not slow" tests/system tests/learning

mutants: $(VENV)/.dev ## break one guarantee after the other in a copy: do its tests fail? (minutes)
	$(BIN)/python -m tests.mutate $(ARGS)

compose-test: $(VENV)/.made ## images and containers, with kills; needs a Docker engine (docs/compose.md)
	$(BIN)/python -m tests.compose.trial $(ARGS)

extras-test: $(VENV)/.dev ## every extra from the wheel, in an environment that holds nothing else
	$(BIN)/python -m tests.extras.trial $(ARGS)

page-test: $(VENV)/.dev ## the web page in a browser: every control, outages, accessibility
	$(BIN)/python -m tests.page.trial $(ARGS)
docs: $(VENV)/.docs ## write the documentation as a site into site/
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --quiet

bench: $(VENV)/.dev ## measure speed and memory, in minutes; the machine should do nothing else
	$(BIN)/python -m benchmarks.run_all --short

profile: $(VENV)/.dev ## measure where a step spends its time, part by part and process by process
	$(BIN)/python -m benchmarks.step_profile

bench-full: $(VENV)/.dev ## the same with all images and rounds, in hours at most
	$(BIN)/python -m benchmarks.run_all

bench-peers: $(PEERS)/.peers ## measure what other projects offer beside ours; installs them apart
	$(PEERS)/bin/python -m benchmarks.run_all $(ARGS) peer_learning peer_replay peer_transport

peers-test: $(PEERS)/.peers ## do others' learners train on the environments? installs them apart
	$(PEERS)/bin/python -m tests.peers.trial

clean: ## remove the virtual environments and all caches; runs stay
	rm -rf $(VENV) $(PEERS) build *.egg-info .mypy_cache .ruff_cache .hypothesis .import_linter_cache
	find shared services experiments benchmarks tools tests -name __pycache__ -prune -exec rm -rf {} +

# ---------------------------------------------------------------- the virtual environment

$(VENV)/.dev: $(VENV)/.all
	$(PIP) install --constraint constraints.txt --editable '.[all,dev]'
	@touch $@

$(VENV)/.docs: $(VENV)/.all
	$(PIP) install --constraint constraints.txt --editable '.[docs]'
	@touch $@

$(VENV)/.all: pyproject.toml constraints.txt $(VENV)/.made
	@echo "installing into $(VENV), this takes a few minutes the first time"
ifneq ($(strip $(TORCH_INDEX_URL)),)
	$(PIP) install --constraint constraints.txt --no-deps --index-url '$(TORCH_INDEX_URL)' torch
endif
	$(PIP) install --constraint constraints.txt --editable '.[all]'
	@touch $@

$(VENV)/.made:
	@command -v $(PYTHON) >/dev/null 2>&1 || \
	  { echo "missing: $(PYTHON); install Python 3.11 or say where it is: make PYTHON=/path/to/python3.11" >&2; exit 1; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info[:2] != (3, 11))' || \
	  { echo "wrong version: $(PYTHON) is $$($(PYTHON) -V 2>&1), expected Python 3.11" >&2; exit 1; }
	@$(PYTHON) -c 'import venv, ensurepip' 2>/dev/null || \
	  { echo "missing: the venv and ensurepip modules of $(PYTHON); on Debian install python3.11-venv" >&2; exit 1; }
	@$(PYTHON) -m venv --clear $(VENV)
	@$(PIP) --version >/dev/null || { echo "missing: pip in $(VENV)" >&2; exit 1; }
	@touch $@

# The same installation in a place of its own: what other projects need stays out of ours.
$(PEERS)/.peers: benchmarks/requirements-peers.txt pyproject.toml constraints.txt
	$(MAKE) VENV=$(PEERS) $(PEERS)/.all
	$(PEERS)/bin/python -m pip --disable-pip-version-check install --constraint constraints.txt \
	  --requirement benchmarks/requirements-peers.txt
	@touch $@
