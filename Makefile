# Everything happens in a virtual environment of this folder's own; nothing else needs to be installed but Python 3.11 or newer.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STORE ?= results

.PHONY: help demo test test-slow test-cluster test-mujoco test-gpu check format bench bench-analysis bench-launch bench-gpu clean

# The native kernels are compiled by the install.
SOURCES := pyproject.toml setup.py $(wildcard agents/kernels/src/*)

help:  ## list the targets
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*##/\t/' | expand -t 16

demo: $(VENV)/installed  ## train the quickstart study, draw its sensitivity regions, answer one question in SQL
	$(BIN)/sweep launch quickstart --store $(STORE)
	$(BIN)/sweep analyze --figure 7.1 --study quickstart --store $(STORE) --out figures
	$(BIN)/sweep sql --store $(STORE) "SELECT agent, critic_step_size, round(low) AS lowest_return, round(high) AS highest_return FROM sensitivity_regions WHERE study = 'quickstart' ORDER BY ALL"

test: $(VENV)/installed-dev  ## the default tests, under ten minutes on two cores
	$(BIN)/python -m pytest -n 2

test-slow: $(VENV)/installed-dev  ## learning at the published level and whatever else takes minutes
	$(BIN)/python -m pytest -m "slow or statistical" -s

test-cluster: $(VENV)/installed-dev  ## tests that kill processes
	$(BIN)/python -m pytest -m cluster

test-mujoco: $(VENV)/installed-dev  ## tests on MuJoCo's physics
	$(BIN)/python -m pytest -m mujoco

test-gpu: $(VENV)/installed-dev  ## tests on a CUDA device
	$(BIN)/python -m pytest -m gpu

check: $(VENV)/installed-dev  ## format, lint, types, import contracts, tests
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports --no-logo
	$(BIN)/python -m pytest -n 2

format: $(VENV)/installed-dev  ## format the code and mend what the linter can
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

bench: $(VENV)/installed-dev  ## agent-steps a second: populations against a plain single agent, and the share of sgemm
	$(BIN)/python tests/benchmarks/training_speed.py --json bench.json

bench-analysis: $(VENV)/installed-dev  ## how fast figures, tables and queries of a store of the thesis' size are
	$(BIN)/python tests/benchmarks/analysis_speed.py --folder build/full-size --json bench-analysis.json

bench-launch: $(VENV)/installed-dev  ## what two cores gain over one through `sweep launch`, in 25 minutes
	$(BIN)/python tests/benchmarks/launch_scaling.py --json bench-launch.json

bench-gpu:  ## the same on a CUDA device, checked against the CPU; needs torch and numpy only, in whatever Python PYTHON is
	PYTHONPATH=. $(PYTHON) tests/benchmarks/gpu_speed.py --json bench-gpu.json

clean:  ## remove the virtual environment and caches, never results
	rm -rf $(VENV) build *.egg-info agents/kernels/*.so bench*.json .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis

$(VENV)/installed: $(SOURCES)
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --editable .
	touch $@

$(VENV)/installed-dev: $(SOURCES)
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --editable '.[dev]'
	touch $@ $(VENV)/installed
