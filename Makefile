# One target for each task. All of them use .venv, which the first one makes.

PYTHON ?=
BACKEND ?= local
VENV := .venv
BIN := $(VENV)/bin
# More tests at a time than processors, since some tests wait for the processes that they started.
# The tests of a file stay together, so that their fixtures are made once.
FAST_TESTS := tests/contract tests/simulation tests/unit
SIDE_BY_SIDE := -q -n $(shell echo $$(($$(nproc) * 3 / 2))) --dist loadfile
FAST := $(BIN)/python -m pytest $(SIDE_BY_SIDE) $(FAST_TESTS)
WHOLE_PROGRAMS := tests/chart tests/examples tests/faults tests/processes tests/releases
# Tests that depend most on the interpreter: pickling, starting and ending processes, threads, locks.
ESSENTIAL_TESTS := $(patsubst %,tests/processes/test_%.py,connection context exit_functions futures \
	loopback pool process queues synchronize) $(patsubst %,tests/unit/test_%.py,reduction \
	shared_objects worker) $(patsubst %,tests/faults/test_%.py,children pool_deaths) \
	tests/conformance/test_executors.py
OTHER_PYTHONS = $(shell .ci/python others $(BIN)/python)
PARTS = test-prepare test-modules $(addprefix test-python-,$(OTHER_PYTHONS)) test-side-by-side
# The tests start hundreds of interpreters. Without bytecode each would compile all of its imports.
unexport PYTHONDONTWRITEBYTECODE
CLUSTER := PYTHONPATH=tests $(BIN)/python -m cluster

.DEFAULT_GOAL := help
.PHONY: help demo test test-fast test-pythons test-long e2e lint bench bench-operator bench-kubernetes paper paper-populations conformance conformance-original published crds docs pictures images cluster cluster-down release release-prepare release-dry-run clean

help:
	@sed -n 's/^## //p' $(MAKEFILE_LIST)

## make demo          evolution strategies on local processes: trains, prints, draws a picture
demo: $(VENV)/.with-rl
	$(BIN)/python examples/02-es/main.py

## make test          all tests but the long ones; the last lines name the parts that failed
test: $(VENV)/.with-dev $(VENV)/.with-stable-baselines3 $(VENV)/.with-jax $(VENV)/.with-games $(VENV)/.with-testsuite $(VENV)/.with-browser
	@PYTHONPATH=tests $(BIN)/python -m announcement $(OTHER_PYTHONS)
	@failed=; \
	for part in $(PARTS); do $(MAKE) --no-print-directory $$part || failed="$$failed $$part"; done; \
	[ -z "$$failed" ] || { echo "make test: failed:$$failed (each is a target of make)" >&2; exit 1; }

.PHONY: test-prepare test-modules test-programs test-side-by-side test-conformance test-on-cluster
test-prepare:
	$(CLUSTER) prepare

test-modules:
	$(FAST)

test-programs:
	$(BIN)/python -m pytest $(SIDE_BY_SIDE) -m "not long" $(WHOLE_PROGRAMS)

# The tests on the cluster wait most of the time, so those that need no cluster run beside them. The
# latter's output is shown at the end. The shell starts background jobs with Ctrl-C ignored, which
# tests of signals would inherit; env resets it.
test-side-by-side:
	@mkdir -p build; rm -f build/test-beside.failed; \
	setsid env --default-signal=INT,QUIT sh -c 'for part in test-conformance test-programs; do \
		$(MAKE) --no-print-directory $$part || echo " $$part" >>build/test-beside.failed; done' \
		>build/test-beside.log 2>&1 & \
	beside=$$!; trap 'kill -s INT -- -$$beside; wait; exit 130' INT TERM; failed=; \
	$(MAKE) --no-print-directory test-on-cluster || failed=" test-on-cluster"; \
	wait $$beside || failed="$$failed test-beside"; cat build/test-beside.log; \
	[ ! -e build/test-beside.failed ] || failed="$$failed$$(tr -d '\n' <build/test-beside.failed)"; \
	[ -z "$$failed" ] || { echo "test-side-by-side: failed:$$failed" >&2; exit 1; }

test-conformance:
	$(BIN)/python -m pytest -m "not long" tests/conformance

test-on-cluster:
	$(BIN)/python -m pytest -m "not long" \
		$(addprefix --ignore=,$(FAST_TESTS) $(WHOLE_PROGRAMS) tests/conformance)

## make test-fast     tests for every save: style, unit, contract, simulation, without the slowest
test-fast: $(VENV)/.with-dev $(VENV)/.with-stable-baselines3
	$(FAST) -m "not slow"

## make test-pythons  the essential tests on every other supported Python of this machine
test-pythons: $(VENV)/.made
	@$(foreach version,$(OTHER_PYTHONS),$(MAKE) --no-print-directory test-python-$(version) &&) true

test-python-%: .venv-%/.with-test
	.venv-$*/bin/python -m pytest $(SIDE_BY_SIDE) $(ESSENTIAL_TESTS)

## make e2e           all scenarios on a real cluster, also long ones: KUBECONFIG's, kind's or our own
e2e: $(VENV)/.with-dev
	$(CLUSTER) prepare
	$(BIN)/python -m pytest tests/e2e

## make test-long     messages of up to 4 GB between hosts, twenty preemptions: minutes, and 14 GB of memory
test-long: $(VENV)/.with-dev
	$(BIN)/python -m pytest -m long tests/faults

## make lint          style, types and import contracts, with each tool's own output
lint: $(VENV)/.with-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

## make bench         every measurement, beside the installed peers; writes docs/benchmarks
bench: $(VENV)/.with-bench $(VENV)/.with-jax $(VENV)/.with-vector-peers
	$(BIN)/python -m benchmarks

## make bench-operator  FiberPools beside ReplicaSets with thousands of pretended pods; floods (root, Go)
bench-operator: $(VENV)/.with-dev
	PYTHONPATH=tests $(BIN)/python -m benchmarks.operator_scale --set-up
	PYTHONPATH=tests $(BIN)/python -m benchmarks.operator_scale.floods --set-up

## make bench-kubernetes  Fiber on pods beside multiprocessing, Ray and Dask (root, Go)
bench-kubernetes: $(VENV)/.with-bench $(VENV)/.with-dev
	PYTHONPATH=tests $(BIN)/python -m benchmarks.kubernetes_cluster
	$(BIN)/python -m benchmarks.relay_memory
	$(BIN)/python -m benchmarks.fanout

## make paper         the paper's experiments beside the peers; writes docs/paper.md and docs/paper
paper: $(VENV)/.with-bench $(VENV)/.with-stable-baselines3 $(VENV)/.with-games
	$(BIN)/python -m benchmarks.paper

## make paper-populations  part (d) of it: pods that follow a population, on a cluster (root, Go)
paper-populations: $(VENV)/.with-dev
	PYTHONPATH=tests $(BIN)/python -m benchmarks.paper.populations --set-up

## make conformance   CPython's tests of multiprocessing and executors, joblib's (BACKEND=local, loopback or kubernetes)
conformance: $(VENV)/.with-dev $(VENV)/.with-testsuite
	$(BIN)/python tests/conformance/run.py --backend $(BACKEND)
	$(BIN)/python tests/conformance/executors.py --backend $(BACKEND)
	$(BIN)/python -m pytest tests/conformance/test_joblib.py

## make conformance-original CHECKOUT=…  the tests and examples of https://github.com/uber/fiber
conformance-original: $(VENV)/.with-dev
	$(BIN)/python tests/conformance/uber_fiber.py "$(CHECKOUT)" --timeout 120

## make published CLONES=…  published programs on Fiber, compared with themselves on multiprocessing
##                    (ONLY="poet DEAP" runs some of them, BACKENDS=local some of the backends)
published: $(VENV)-published/.with-published
	PYTHONPATH=tests $(VENV)-published/bin/python -m published "$(CLONES)" \
		$(if $(ONLY),--only $(ONLY)) $(if $(BACKENDS),--backends $(BACKENDS))

## make crds          crds/fiberpools.yaml and the chart's copy, from the model
crds: $(VENV)/.with-dev
	$(BIN)/python -m fiber_api.schema

## make docs          the documentation as a site, into build/site, and the tutorial as a notebook; warnings and
##                    broken links are errors
docs: $(VENV)/.with-docs
	$(BIN)/python -m docsite.notebook
	$(BIN)/python -m docsite

## make pictures      the pictures of terminals in the documentation
pictures: $(VENV)/.with-dev
	$(BIN)/python -m docsite.terminal_pictures

## make images        the operator's image and the workers', by docker or buildah, into build/images
images: $(VENV)/.made
	$(CLUSTER) images

## make cluster       a Kubernetes cluster on this machine, with the images (root, Go);
##                    eval "$(make -s cluster)" sets KUBECONFIG, PATH and FIBER_IMAGE in the shell
cluster: $(VENV)/.made
	@$(CLUSTER) up --images

## make cluster-down  stop that cluster and delete its files
cluster-down: $(VENV)/.made
	$(CLUSTER) down

## make release-prepare VERSION=1.2.0  write the version and the changelog (docs/releasing.md)
release-prepare: $(VENV)/.with-dev
	$(BIN)/python -m release prepare "$(VERSION)"

# The workflow of a release runs this for its tag.
release: $(VENV)/.with-dev
	$(BIN)/python -m release build --tag "$(TAG)" --registry "$(REGISTRY)"

## make release-dry-run  everything of a release but publishing, into build/release
release-dry-run: $(VENV)/.with-dev
	PATH="$$PATH:$$(PYTHONPATH=tests $(BIN)/python -c 'from cluster import places; print(places.programs())')" \
		$(BIN)/python -m release build

## make clean         remove the environments and the files of the tools
clean:
	rm -rf $(VENV) .venv-* build dist .pytest_cache .mypy_cache .ruff_cache .hypothesis .import_linter_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

##
## PYTHON=python3.12 make test    chooses the interpreter of a new .venv; make clean first

# The environment. Each stamp file is newer than the files that its installation was made from.
$(VENV)/.made:
	.ci/python make-venv $(VENV) $(PYTHON)
	touch $@

$(VENV)/.with-rl: EXTRAS := rl
$(VENV)/.with-dev: EXTRAS := dev,rl
$(VENV)/.with-bench: EXTRAS := bench,rl
$(VENV)/.with-docs: EXTRAS := docs
$(VENV)/.with-rl $(VENV)/.with-dev $(VENV)/.with-bench $(VENV)/.with-docs: $(VENV)/.made pyproject.toml
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[$(EXTRAS)]'
	touch $@

# Without torch, which only learning needs, and which is larger than all other packages together.
$(VENV)/.with-stable-baselines3: $(VENV)/.with-dev
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps 'stable-baselines3>=2.4'
	touch $@

# JAX starts threads at import most often. Where it has no wheel, its tests are skipped.
$(VENV)/.with-jax: $(VENV)/.with-dev
	-$(BIN)/python -m pip install --quiet --disable-pip-version-check --only-binary :all: 'jax>=0.4'
	touch $@

# Other libraries with vector environments, for the benchmarks. Without torch, as above. A library
# without a wheel is left out.
$(VENV)/.with-vector-peers: $(VENV)/.with-bench
	-$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps 'stable-baselines3>=2.4'
	-$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps 'pufferlib-core>=3'
	-$(BIN)/python -m pip install --quiet --disable-pip-version-check --only-binary :all: 'envpool>=1.2'
	touch $@

# Real environments of the paper's experiments: Box2D, and Atari's emulator with its games. Where
# they have no wheel, their tests are skipped.
$(VENV)/.with-games: $(VENV)/.with-dev
	-$(BIN)/python -m pip install --quiet --disable-pip-version-check --only-binary :all: 'gymnasium[box2d]>=1.0' 'ale-py>=0.10'
	touch $@

$(VENV)/.with-testsuite: $(VENV)/.made
	.ci/python need-testsuite $(BIN)/python
	touch $@

# Chromium. Where it cannot be installed, the tests of the dashboard in a browser are skipped.
$(VENV)/.with-browser: $(VENV)/.made
	-.ci/browser && touch $@

# torch is larger than all other packages together, so only this environment has it.
$(VENV)-published/.made:
	.ci/python make-venv $(VENV)-published $(PYTHON)
	touch $@

$(VENV)-published/.with-published: $(VENV)-published/.made pyproject.toml tests/published/requirements.txt
	$(VENV)-published/bin/python -m pip install --quiet --disable-pip-version-check \
		--editable '.[kubernetes,vector]' --requirement tests/published/requirements.txt
	touch $@

.venv-%/.made:
	.ci/python make-venv .venv-$* "$$(.ci/python find $*)"
	touch $@

.venv-%/.with-test: .venv-%/.made pyproject.toml
	.venv-$*/bin/python -m pip install --quiet --disable-pip-version-check --editable '.[test]'
	touch $@
.PRECIOUS: .venv-%/.made .venv-%/.with-test
