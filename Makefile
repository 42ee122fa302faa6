# make run | make test | make check, from a clean checkout with nothing but Python >= 3.11 on Linux x86-64.
# VENV=dir puts the virtual environment elsewhere, PYTHON=path chooses the interpreter.

SHELL := /bin/bash
VENV ?= .venv
INSTALLED := $(VENV)/.simtrack-installed
BIN := $(VENV)/bin
ARGS ?=

.DEFAULT_GOAL := help
.PHONY: help install run test check format clean

help:
	@echo 'make run    simulate the workbench and write a report   (ARGS="lab_floor --duration 60")'
	@echo 'make test   run the tests                               (ARGS="tests/raycast -k motion")'
	@echo 'make check  lint, formatting, types'
	@echo 'make format let ruff format and fix what it can'
	@echo 'make clean  remove the virtual environment and caches'

install: $(INSTALLED)

run: $(INSTALLED)
	$(BIN)/simtrack run $(ARGS)

test: $(INSTALLED)
	$(BIN)/python -m pytest -n 2 --dist loadfile $(ARGS)

check: $(INSTALLED)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	PYRIGHT_PYTHON_IGNORE_WARNINGS=1 $(BIN)/pyright --pythonpath $(BIN)/python

format: $(INSTALLED)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

clean:
	rm -rf $(VENV) build dist .pytest_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# ---------------------------------------------------------------------------------------------------- installation

# The first interpreter that is new enough and can make virtual environments; 3.11 is what is tested.
PYTHON ?= $(shell for python in python3.11 python3 python3.12 python3.13; do \
	$$python -c 'import sys, venv, ensurepip; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && { echo $$python; break; }; \
	done)

$(INSTALLED): pyproject.toml
	@if [ -z "$(PYTHON)" ]; then \
		echo 'simtrack needs Python 3.11 or newer with its venv module, and found none.' >&2; \
		echo 'On Debian and Ubuntu: apt-get install python3 python3-venv; or name one: make PYTHON=/path/to/python' >&2; \
		exit 1; \
	fi
	@echo 'Installing simtrack into $(VENV): a few minutes the first time.'
	@[ -x $(BIN)/python ] || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[dev,viz,distributed]'
	@$(MAKE) --no-print-directory opengl
	@touch $@

# Headless OpenGL (EGL with Mesa's software renderer) is a system library, which pip cannot bring. Without it the Embree
# renderer does the work, so that failing here is no error.
OPENGL_PACKAGES := libegl1 libopengl0 libgl1 libegl-mesa0 libgl1-mesa-dri
TRY_OPENGL := MUJOCO_GL=egl $(BIN)/python -c 'import mujoco; mujoco.GLContext(8, 8).make_current()' >/dev/null 2>&1

.PHONY: opengl
opengl:
	@$(TRY_OPENGL) && exit 0; \
	if command -v apt-get >/dev/null; then \
		sudo=; [ "$$(id -u)" = 0 ] || sudo='sudo -n'; \
		echo 'No headless OpenGL; installing $(OPENGL_PACKAGES)'; \
		{ $$sudo apt-get update -qq && DEBIAN_FRONTEND=noninteractive \
			$$sudo apt-get install -y -qq --no-install-recommends $(OPENGL_PACKAGES); } >/dev/null 2>&1; \
	fi; \
	$(TRY_OPENGL) || echo 'No headless OpenGL (EGL): simtrack renders with Embree instead, more slowly. To change' \
		'that, install $(OPENGL_PACKAGES) or what your system calls them.'
