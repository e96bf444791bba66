PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
# One thread for each process: two that fight over the cores are slower than one.
export OMP_NUM_THREADS ?= 1

.PHONY: setup train demo test slow lint docs gpu generalisation results

setup: $(STAMP)

$(STAMP): pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt torch
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e ".[dev]"
	touch $(STAMP)

train: setup
	$(BIN)/python -m saferl experiment=quickstart

# The agent that ships beside the blind driver in the same 50 episodes, and a page that plays them.
demo: setup
	rm -rf build/demo
	$(BIN)/python -m saferl.evaluate pretrained=arsac task=mixed episodes=50 trace=all why=true out=build/demo/arsac
	$(BIN)/python -m saferl.evaluate policy=blind task=mixed episodes=50 trace=all why=true out=build/demo/blind
	$(BIN)/python -m saferl.report build/demo --out build/demo

test: setup
	$(BIN)/python -m pytest -n 2 -q

slow: setup
	$(BIN)/python -m pytest -m slow -q

gpu: setup
	$(BIN)/python benchmarks/gpu.py $(or $(OUT),runs/gpu)

docs: setup
	$(BIN)/sphinx-build -W --keep-going -q -d build/doctrees docs build/docs

# One table of RUN and two drivers: other traffic, the other backend, without the projector.
CONDITIONS = task=$(or $(TASK),mixed) task.scenario=nominal,dense,aggressive,noisy env=batched,highway \
	episodes=$(or $(EPISODES),100) out=$(or $(OUT),generalisation)

generalisation: setup
	test -n "$(RUN)" || { echo "Give RUN=FOLDER, or several, RUN=A,B."; exit 1; }
	$(BIN)/python -m saferl.evaluate -m policy=scripted,blind $(CONDITIONS)
	$(BIN)/python -m saferl.evaluate -m checkpoint=$(RUN) project=true,false $(CONDITIONS)

# The tables of docs/results/comparison.md, from the numbers of finished runs beside it.
results: setup
	$(BIN)/python -m saferl.report docs/results/numbers --out build/results
	sed "1s/.*/# The paper's comparison/" build/results/report.md > docs/results/comparison.md
	cp build/results/curves.png docs/results

lint: setup
	$(BIN)/ruff check . && $(BIN)/ruff format --check . && $(BIN)/pyright
