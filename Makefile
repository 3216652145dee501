# make demo   set up and show the main job, in a few minutes
# make test   set up and run lint, import contracts, types and tests; of these `make lint` runs all but the tests
# make check  the longer tests: every README command, Monte Carlo, memory, pictures, a browser
# make oldest the tests with the oldest versions that pyproject.toml allows, but for torch
# make docs   the documentation, as pages in docs/_build
# make dist   the source archive and the wheel, checked
# make bench  speed and memory, as ratios within one run
PYTHON ?= python3
BIN := .venv/bin
# Bytecode is written when a module is first imported, as most modules of large packages never are; also where Python was
# told not to, as in many containers: each of some hundred commands would compile all that it imports again.
export PYTHONDONTWRITEBYTECODE :=
PIP := $(BIN)/python -m pip install --quiet --no-compile --disable-pip-version-check --constraint constraints.txt

.PHONY: demo test lint tests check oldest bench docs dist clean

.venv/pip-ready:
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check 'pip>=25.1'
	@touch $@

.venv/demo-ready: .venv/pip-ready pyproject.toml constraints.txt
	@echo "setting up .venv (a few minutes, once)"
	$(PIP) --editable '.[train,sim]'
	@touch $@

.venv/test-ready: .venv/demo-ready
	$(PIP) --editable '.[all,dask]' --group dev
	@touch $@

demo: .venv/demo-ready
	$(BIN)/python examples/demo.py

# Matrices are small, and two processes share the machine: more threads would only wait for one another.
demo tests check: export OMP_NUM_THREADS = 1

# Types are checked beside the tests, which leave a processor idle now and then.
test: .venv/test-ready
	@$(MAKE) --no-print-directory --jobs 2 lint tests

lint: .venv/test-ready
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports --no-cache
	$(BIN)/mypy

tests: .venv/test-ready
	$(BIN)/python -m pytest -n 2 --dist worksteal -m "not slow"

# Only files with longer tests are loaded, by each of the workers.
check: .venv/test-ready
	$(BIN)/python -m pytest -n 2 --dist worksteal -m slow $$(grep -rl --include='*.py' 'mark\.slow' tests | sort)

# The newest patch of each; torch, of which others may bring CUDA along, as in constraints.txt.
oldest:
	$(PYTHON) -m venv .venv-oldest
	sed -n '/^dependencies/,/^\[dependency/p' pyproject.toml | grep -oE '"[A-Za-z0-9._-]+>=[0-9.]+' | \
	  sed -E 's/"(.*)>=(.*)/\1==\2.*/; /^torch==/d' > .venv-oldest/versions.txt
	grep '^torch==' constraints.txt >> .venv-oldest/versions.txt
	.venv-oldest/bin/python -m pip install --quiet --upgrade 'pip>=25.1'
	.venv-oldest/bin/python -m pip install --quiet --constraint .venv-oldest/versions.txt --editable '.[all,dask,viz]' --group dev
	OMP_NUM_THREADS=1 .venv-oldest/bin/python -m pytest -n 2 --dist worksteal -m "not slow"

bench: .venv/test-ready
	$(BIN)/python -m bench

docs: .venv/test-ready
	$(BIN)/sphinx-build -q -W --keep-going -b html docs docs/_build/html
	@echo docs/_build/html/index.html

dist: .venv/test-ready
	$(PIP) build check-wheel-contents twine
	rm -rf dist
	$(BIN)/python -m build
	$(BIN)/twine check --strict dist/*
	$(BIN)/check-wheel-contents dist/*.whl

clean:
	rm -rf .venv .venv-oldest out dist build .pytest_cache .mypy_cache .ruff_cache
