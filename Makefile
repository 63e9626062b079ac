# Everything happens in .venv; only make and a Python >= 3.10 must be there before.
#
#   make install               set .venv up (the other targets do so by themselves)
#   make test                  all tests; more for pytest: make test PYTEST_ARGS='-k flows -x'
#   make lint                  style, format and types
#   make demo                  learn a drawn face and let it speak: see demo/report.html
#   make bench                 how fast this machine does the work: BENCH_ARGS=--peers
#   make clean                 remove .venv and all that was made; your own files stay
#
# Another Python: make install PYTHON=/path/to/python

SHELL := /bin/sh
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
PYTEST_ARGS ?=
BENCH_ARGS ?=

NEW_ENOUGH := import sys; sys.exit(sys.version_info < (3, 10))
CANDIDATES := python3 python python3.13 python3.12 python3.11 python3.10
FIND_PYTHON := for p in $(CANDIDATES); do "$$p" -c "$(NEW_ENOUGH)" && echo "$$p" && break; done
PYTHON ?= $(shell ($(FIND_PYTHON)) 2>/dev/null)

.PHONY: help install lint test demo bench clean
.DELETE_ON_ERROR:

help:
	@sed -n 's/^#   //p' Makefile

install: $(READY)

$(READY): pyproject.toml
	@test -n "$(PYTHON)" || { echo "make: no Python >= 3.10 found; give one: make PYTHON=/path/to/python"; exit 1; }
	@"$(PYTHON)" -c "$(NEW_ENOUGH)" 2>/dev/null || { echo "make: $(PYTHON) is no Python >= 3.10; give another: make PYTHON=/path/to/python"; exit 1; }
	@echo "Setting up $(VENV) (some minutes, once)"
	@$(BIN)/python -m pip --version >/dev/null 2>&1 || "$(PYTHON)" -m venv $(VENV)
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[dev]'
	@touch $@

lint: $(READY)
	@$(BIN)/ruff check --quiet .
	@$(BIN)/ruff format --quiet --check . || { echo "not formatted (mend with: $(BIN)/ruff format):"; $(BIN)/ruff format --check .; exit 1; }
	@$(BIN)/mypy

test: $(READY)
	@$(BIN)/pytest $(PYTEST_ARGS)

demo: $(READY)
	@$(BIN)/mmmgpu demo --out demo

bench: $(READY)
	@$(BIN)/python -m bench $(BENCH_ARGS)

clean:
	@rm -rf $(VENV) build dist demo *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
	@find . -name __pycache__ -type d -prune -exec rm -rf {} +
