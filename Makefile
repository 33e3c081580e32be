# elastocal: needs Python 3.11 or newer with pip and venv, and make. `make help` lists the targets.

PYTHON ?= python3
# Empty (make CONSTRAINTS= test): let pip choose the newest versions instead of the tested ones.
CONSTRAINTS ?= constraints.txt
WORKERS ?= 2
PYTEST_ARGS ?=
VERSIONS_ARGS ?=
BENCH_ARGS ?=
GOLDEN ?=

VENV := .venv
BIN := $(VENV)/bin
RUN_TIME := $(VENV)/.run-time-installed
TEST_TOOLS := $(VENV)/.test-tools-installed
PIP_INSTALL = $(BIN)/python -m pip install --quiet --disable-pip-version-check \
	$(if $(strip $(CONSTRAINTS)),-c "$(strip $(CONSTRAINTS))")
PYTEST = $(BIN)/python -m pytest -n $(WORKERS) --dist worksteal

# An environment remembers the folder it was made for: one that was copied or moved along with
# the tree still runs the code of its first home, and is made anew.
HOME_FILE := $(VENV)/.made-for
ifneq ($(shell cat $(HOME_FILE) 2>/dev/null),$(CURDIR))
NOT_AT_HOME := not-at-home
endif

.DEFAULT_GOAL := help
.PHONY: help demo test test-long golden golden-accept test-versions bench lint docs docs-figures clean not-at-home
.DELETE_ON_ERROR:

help:
	@echo "make demo       set up .venv if needed, then calibrate a simulated arm"
	@echo "make test       the test suite              (PYTEST_ARGS=\"tests/model -x\", WORKERS=2)"
	@echo "make test-long  the long studies among the tests"
	@echo "make golden     what commands and the front door give, beside tests/golden/expected  (GOLDEN=\"demo next\")"
	@echo "make golden-accept  takes what differs as meant                          (GOLDEN=\"demo\", GOLDEN=all)"
	@echo "make test-versions  the wheel with every other supported Python that is found (VERSIONS_ARGS=--one), then a"
	@echo "                    slice of the tests with the oldest and the newest of what it needs"
	@echo "make bench      the benchmarks, to benchmarks/result.md      (BENCH_ARGS=--full: all sizes)"
	@echo "make lint       ruff check, ruff format --check, mypy"
	@echo "make docs       the documentation as pages in site/ (strict: a broken link is an error)"
	@echo "make docs-figures  its figures anew"
	@echo "make clean      remove .venv, caches and build products"
	@echo
	@echo "PYTHON=python3.12 chooses the interpreter a new .venv is made with (3.11 or newer);"
	@echo "CONSTRAINTS= installs the newest versions instead of those in constraints.txt."

demo: $(RUN_TIME)
	$(BIN)/elastocal demo

# One thread for each worker: linear algebra would otherwise start as many as there are cores.
test test-long golden golden-accept: export OPENBLAS_NUM_THREADS = 1
test test-long golden golden-accept: export OMP_NUM_THREADS = 1
test test-long golden golden-accept: export MKL_NUM_THREADS = 1
# What is compiled to bytecode is kept: the tests start some hundred processes.
test test-long: export PYTHONDONTWRITEBYTECODE =

test: $(TEST_TOOLS)
	$(PYTEST) $(PYTEST_ARGS)

test-long: $(TEST_TOOLS)
	$(PYTEST) -m long $(PYTEST_ARGS)

golden golden-accept: export PYTHONPATH = tests

golden: $(TEST_TOOLS)
	@$(BIN)/python -m golden show $(GOLDEN)

golden-accept: $(TEST_TOOLS)
	@$(BIN)/python -m golden accept $(GOLDEN)

test-versions: $(RUN_TIME)
	$(BIN)/python tests/versions.py $(VERSIONS_ARGS)
	$(BIN)/python tests/versions.py --slices

bench: $(RUN_TIME)
	$(BIN)/python benchmarks/run.py $(BENCH_ARGS)

lint: $(TEST_TOOLS)
	$(BIN)/python -m ruff check .
	$(BIN)/python -m ruff format --check .
	$(BIN)/python -m mypy src

# Not --quiet: mkdocs then counts no warning, and strict means nothing.  The theme's advertisement
# of its successor is not a result of the build.
docs: export NO_MKDOCS_2_WARNING = 1
docs: $(TEST_TOOLS)
	$(BIN)/python -m mkdocs build --strict

docs-figures: $(RUN_TIME)
	$(BIN)/python docs/figures/all.py

clean:
	rm -rf $(VENV) build dist demo_out site src/elastocal.egg-info
	rm -rf .mypy_cache .ruff_cache .pytest_cache .hypothesis
	find src tests experiment_design -name __pycache__ -type d -prune -exec rm -rf {} +

$(HOME_FILE): $(NOT_AT_HOME)
	@command -v "$(PYTHON)" >/dev/null 2>&1 || { \
	  echo "elastocal needs Python 3.11 or newer; there is no '$(PYTHON)'." \
	    "Name yours: make PYTHON=/path/to/python3" >&2; exit 1; }
	@"$(PYTHON)" -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	  echo "elastocal needs Python 3.11 or newer; '$(PYTHON)' is $$("$(PYTHON)" --version 2>&1)." \
	    "Name a newer one: make PYTHON=python3.12" >&2; exit 1; }
	@echo "Making $(VENV) with $$("$(PYTHON)" --version)"
	@if [ -e $(VENV) ] && [ ! -e $@ ]; then \
	  echo "$(VENV) was not made by this Makefile; move it away, or remove it: make clean" >&2; exit 1; fi
	@"$(PYTHON)" -m venv --clear $(VENV) || { rm -rf $(VENV); exit 1; }
	@printf '%s\n' "$(CURDIR)" > $@

$(RUN_TIME): $(HOME_FILE) pyproject.toml $(wildcard $(CONSTRAINTS))
	@echo "Installing elastocal and what it runs on (a few minutes the first time)"
	@$(PIP_INSTALL) -e .
	@touch $@

$(TEST_TOOLS): $(RUN_TIME)
	@echo "Installing the test tools"
	@$(PIP_INSTALL) -e ".[test,dev,docs]"
	@touch $@
