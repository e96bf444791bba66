PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
# One thread for each process: two that fight over the cores are slower than one.
export OMP_NUM_THREADS ?= 1

.PHONY: setup train test slow lint docs gpu

setup: $(STAMP)

$(STAMP): pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt torch
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e ".[dev]"
	touch $(STAMP)

train: setup
	$(BIN)/python -m saferl experiment=quickstart

test: setup
	$(BIN)/python -m pytest -n 2 -q

slow: setup
	$(BIN)/python -m pytest -m slow -q

gpu: setup
	$(BIN)/python benchmarks/gpu.py $(or $(OUT),runs/gpu)

docs: setup
	$(BIN)/sphinx-build -W --keep-going -q -d build/doctrees docs build/docs

lint: setup
	$(BIN)/ruff check . && $(BIN)/ruff format --check . && $(BIN)/pyright
