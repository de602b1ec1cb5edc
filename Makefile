# Everything below needs only python3 (3.11 or later), pip and make.
PYTHON ?= python3
WORKERS ?= 2
DEMO_DIR ?= runs/demo

VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
PYTEST := OMP_NUM_THREADS=1 $(BIN)/python -m pytest -q

.DEFAULT_GOAL := help
.PHONY: help demo test slow lint format bench clean

help:  ## list the targets
	@awk -F ':.*## ' '/^[a-z]+:.*## / {printf "  make %-8s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

# The stamp makes a changed pyproject.toml or constraints.txt reinstall, and a failed install start again.
$(READY): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(0 if sys.version_info >= (3, 11) else "Python 3.11 or later is needed: make PYTHON=/path/to/python3.11")'
	@echo "Installing ponn-torch and its dependencies into $(VENV) (a few minutes the first time) ..."
	@$(PYTHON) -m venv $(VENV)
	@$(BIN)/python -m pip install -qq --disable-pip-version-check -c constraints.txt -e ".[dev,baselines,parallel,notebooks]"
	@touch $@

demo: $(READY)  ## solve the default problem (Earth-Mars transfer), fly it and certify it
	@$(BIN)/ponn hydra.run.dir=$(DEMO_DIR)
	@echo "Results are in $(DEMO_DIR)/"

test: lint  ## lint, types, architecture and the fast tests: what CI runs
	@$(PYTEST) -n $(WORKERS)

slow: $(READY)  ## the slow tests only
	@$(PYTEST) -n $(WORKERS) -m slow

lint: $(READY)  ## ruff, mypy and import-linter
	@$(BIN)/ruff check -q .
	@$(BIN)/ruff format -q --check . || { echo "run 'make format'"; exit 1; }
	@$(BIN)/mypy --no-error-summary
	@$(BIN)/lint-imports > $(VENV)/lint-imports.log || { cat $(VENV)/lint-imports.log; exit 1; }

format: $(READY)  ## let ruff fix and format the code
	@$(BIN)/ruff check -q --fix .
	@$(BIN)/ruff format -q .

bench: $(READY)  ## the benchmark study (long)
	@PATH="$(CURDIR)/$(BIN):$$PATH" bash experiments/benchmark/run.sh

clean:  ## remove the virtual environment, caches and build leftovers (runs/ is kept)
	@rm -rf $(VENV) build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis
	@find . -name __pycache__ -type d -prune -exec rm -rf {} +
