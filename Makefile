# Each target sets up what it needs: a fresh clone and Python 3.11 or later are enough.
PYTHON ?= python3
BIN := .venv/bin

.PHONY: demo test check acceptance benchmark clean

.venv/.ready: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	touch $@

demo: .venv/.ready  ## a synthetic camera, its captures, every untrained method
	$(BIN)/mwdn demo

# Threads that wait by spinning starve each other where other processes share the machine; alone they are the faster.
test: .venv/.ready  ## everything but the slow checks on real captures
	OMP_WAIT_POLICY=passive OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n auto --dist worksteal

check: .venv/.ready  ## lint, format, types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

acceptance: .venv/.ready  ## real captures (MWDN_DATA, or ../shared/data); pictures go to results/acceptance
	$(BIN)/python -m pytest -m acceptance -s

benchmark: .venv/.ready  ## speed against plain baselines in the same run
	$(BIN)/python benchmarks/admm.py
	$(BIN)/python benchmarks/memory.py
	$(BIN)/python benchmarks/train.py
	$(BIN)/python benchmarks/engine.py --memory

clean:
	rm -rf .venv results .pytest_cache .mypy_cache .ruff_cache
