# make install | study | test | test-long | lint | coverage | mutants | docs | docs-version | net | dist | clean
# Another build of torch: make install TORCH=torch
# Another Python, with an environment of its own beside .venv: make test PYTHON=python3.12
PYTHON ?= python3
VENV ?= .venv$(if $(filter-out python3,$(PYTHON)),-$(subst /,-,$(PYTHON:/%=%)))
TORCH ?=
BIN := $(VENV)/bin
DIST := dist

.PHONY: install study test test-long lint coverage mutants docs docs-version net dist clean

install: $(VENV)/.installed

# torch first: the CPU build where pip offers one, else the release it belongs to, so that no GPU libraries are pulled
# onto a machine without a GPU by an open version range.
$(VENV)/.installed: pyproject.toml
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
ifeq ($(TORCH),)
	$(BIN)/python -m pip install --quiet "torch==2.13.0+cpu" 2>/dev/null || $(BIN)/python -m pip install "torch==2.13.0"
else
	$(BIN)/python -m pip install "$(TORCH)"
endif
	$(BIN)/python -m pip install --quiet --editable ".[dev]"
	touch $@

study: install
	$(BIN)/tint-sumo study run --budget quick --out runs/quick

test: lint
	$(BIN)/pytest -n 2 --dist worksteal

test-long: install
	$(BIN)/pytest -m long

lint: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

coverage: install
	$(BIN)/pytest -n 2 --dist worksteal --cov --cov-report=term:skip-covered

mutants: install
	$(BIN)/python scripts/mutants.py $(MUTANTS)

docs: install
	PATH="$(abspath $(BIN)):$$PATH" NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet
	@echo "open build/docs/index.html"

# A version of the site beside the others, on the branch gh-pages: make docs-version NAMES="0.1 latest"
docs-version: install
	PATH="$(abspath $(BIN)):$$PATH" NO_MKDOCS_2_WARNING=1 OFFLINE=false $(BIN)/mike deploy --update-aliases $(NAMES)

net: install
	$(BIN)/tint-sumo net --out sumo_net

dist: install
	rm -rf $(DIST)
	$(BIN)/hatchling build --directory $(DIST)
	$(BIN)/twine check --strict $(DIST)/*
	$(BIN)/check-wheel-contents $(DIST)/*.whl

clean:
	rm -rf build dist .coverage* .mypy_cache .ruff_cache .pytest_cache .import_linter_cache
