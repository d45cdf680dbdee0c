# One target per chore. Everything happens in .venv, which the first target makes.
#   PYTHON=python3.12 make test    chooses the interpreter of a new .venv

PYTHON ?=
BACKEND ?= local
VENV := .venv
BIN := $(VENV)/bin

.DEFAULT_GOAL := help
.PHONY: help demo test test-fast lint bench conformance clean

help:
	@sed -n 's/^## //p' $(MAKEFILE_LIST)

## make demo          evolution strategies on local processes: trains, prints, draws a picture
demo: $(VENV)/.with-rl
	$(BIN)/python examples/02-es/main.py

## make test          every test: style, unit, simulation, faults, conformance, examples
test: $(VENV)/.with-dev $(VENV)/.with-testsuite
	$(BIN)/python -m pytest

## make test-fast     what to run at every save: style, unit, simulation
test-fast: $(VENV)/.with-dev
	$(BIN)/python -m pytest -q tests/unit tests/simulation

## make lint          style, types and import contracts, each tool's own words
lint: $(VENV)/.with-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

## make bench         every measure beside the installed peers; writes docs/benchmarks
bench: $(VENV)/.with-bench
	$(BIN)/python -m benchmarks

## make conformance   CPython's own multiprocessing tests (BACKEND=local or loopback)
conformance: $(VENV)/.with-dev $(VENV)/.with-testsuite
	$(BIN)/python tests/conformance/run.py --backend $(BACKEND)

## make clean         remove the environment and what the tools wrote
clean:
	rm -rf $(VENV) build dist .pytest_cache .mypy_cache .ruff_cache .hypothesis .import_linter_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# The environment. Each stamp is newer than what its installation was made from.
$(VENV)/.made:
	.ci/python make-venv $(VENV) $(PYTHON)
	touch $@

$(VENV)/.with-rl: EXTRAS := rl
$(VENV)/.with-dev: EXTRAS := dev,rl
$(VENV)/.with-bench: EXTRAS := bench,rl
$(VENV)/.with-rl $(VENV)/.with-dev $(VENV)/.with-bench: $(VENV)/.made pyproject.toml
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[$(EXTRAS)]'
	touch $@

$(VENV)/.with-testsuite: $(VENV)/.made
	.ci/python need-testsuite $(BIN)/python
	touch $@
