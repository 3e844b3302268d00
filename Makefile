# The project's commands. `make demo` and `make test` set everything up by themselves.
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
PIP    := $(BIN)/python -m pip install --quiet --disable-pip-version-check
STAMP  := $(VENV)/.installed
LOOPS  := $(VENV)/.compiled
DIST   := dist

PARALLEL := -n auto --dist loadgroup --durations=25

# Tests start thousands of programs; without bytecode each of them compiles all that it imports.
export PYTHONDONTWRITEBYTECODE :=

.PHONY: help packages install demo test test-all collect test-quick fuzz faults moments kills wheel lint format docs reference bench lock clean

help:
	@echo "make demo    engine, containers and a simulated fleet, with its web page"
	@echo "make test    everything: linters, types, docs, unit, integration and end-to-end tests"
	@echo "make test-all  make test without linters and types        make test-quick  most unit tests"
	@echo "make fuzz    send the servers what no client would; EXAMPLES=5000 of each kind"
	@echo "make faults  kill, cut off and slow down masters and etcd; ARGS=\"--only kill --rounds 100 --seed 7\""
	@echo "make moments  end rce up at random moments by random signals; COUNT=200 times, SEED=1"
	@echo "make kills   kill planner and fleet manager under load: KILLS=20 times, some minutes"
	@echo "make lint    ruff and mypy        make format   rewrite the layout"
	@echo "make bench   measure              make lock     pin the dependencies anew"
	@echo "make docs    the documentation as a site, in build/docs; needs no network"
	@echo "make reference  the pages of settings, options and life cycles"
	@echo "make wheel   dist/rce-VERSION-py3-none-any.whl, which other machines install without a checkout"
	@echo "make install only the set-up      make clean    remove what make made"

install: $(STAMP) $(LOOPS)

packages: $(STAMP)

# Twice as fast as the pip that Python brings, which also makes bytecode on one core only: the lock's own pip
# installs the packages, and all cores make bytecode, but not of tests.
$(STAMP): requirements.lock pyproject.toml
	@$(PYTHON) -c 'import sys; v = sys.version_info; sys.exit(v < (3, 11) and "RCE needs Python 3.11 or newer; this is %d.%d (set PYTHON=...)" % v[:2])'
	$(PYTHON) -m venv $(VENV)
	sed -n '/^pip==/,/[^\\]$$/p' requirements.lock >$(VENV)/pip.txt
	$(PIP) --require-hashes -r $(VENV)/pip.txt
	$(PIP) --require-hashes --no-deps --no-compile -r requirements.lock
	$(PIP) --no-deps --no-build-isolation --editable .
	$(BIN)/python -m compileall -q -j 0 -x '/(tests|pip|setuptools)/' $(VENV)/lib
	@touch $@

$(LOOPS): $(STAMP)
	$(BIN)/rce compile
	@touch $@

demo: install
	@exec $(BIN)/rce demo $(ARGS)

test: lint docs
	@$(MAKE) --no-print-directory test-all

test-all: install
	$(BIN)/python -m pytest $(PARALLEL) $(ARGS)

# Makes the tests' bytecode once; else each of the workers, which start together, makes it.
collect: install
	$(BIN)/python -m pytest --collect-only --quiet --quiet >/dev/null

fuzz: install
	RCE_FUZZ_EXAMPLES=$(or $(EXAMPLES),5000) $(BIN)/python -m pytest --timeout 3600 \
		$(wildcard tests/integration/*/test_*_fuzz.py tests/integration/*/test_*openapi.py) $(ARGS)

faults: install
	PYTHONPATH=tests $(BIN)/python -m faults $(ARGS)

moments: install
	PYTHONPATH=tests $(BIN)/python -m support.moments $(or $(SEED),1) $(or $(COUNT),200)

kills: install
	RCE_KILLS=$(or $(KILLS),20) $(BIN)/python -m pytest -s --timeout 3600 \
		tests/integration/fleet_nodes/test_fleet_manager_killed.py $(ARGS)

test-quick: install
	$(BIN)/python -m pytest -n logical -m "not slow" --hypothesis-profile=quick --durations=5 tests/unit $(ARGS)

# For machines without a checkout; needs no network.
wheel: packages
	$(BIN)/python -m pip wheel --quiet --disable-pip-version-check --no-index --no-deps --no-build-isolation \
		--wheel-dir $(DIST) .

lint: packages
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/python -m tools.audit

format: packages
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

docs: packages
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict

reference: packages
	$(BIN)/python -m tools.reference

bench: install
	$(BIN)/python -m benchmarks $(ARGS)

lock:
	$(PYTHON) -m venv $(VENV)-lock
	$(VENV)-lock/bin/python -m pip install --quiet uv
	$(VENV)-lock/bin/uv pip compile --quiet --universal --python-version 3.11 --extra dev --generate-hashes \
		--no-emit-index-url --no-emit-find-links --no-annotate --custom-compile-command "make lock" \
		pyproject.toml -o requirements.lock
	rm -rf $(VENV)-lock

clean:
	rm -rf $(VENV) artifacts build dist .mypy_cache .ruff_cache .pytest_cache .hypothesis benchmarks/results
	rm -rf rce_fleet/__compiled__
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
