# Each target sets up its own environment: a fresh clone and Python 3.11 or later are enough.
PYTHON ?= python3
BIN := .venv/bin

.PHONY: demo test check docs acceptance package benchmark clean

.venv/.ready: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	touch $@

demo: .venv/.ready  ## a synthetic camera, its captures, the untrained methods
	$(BIN)/mwdn demo

# Spinning threads slow down other processes on the same cores, so tests wait passively; a single process is faster without.
test: .venv/.ready  ## all tests except the slow ones on real captures
	OMP_WAIT_POLICY=passive OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n auto --dist worksteal

check: .venv/.ready  ## lint, format, types, documentation
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

docs: .venv/.ready  ## the documentation site at http://127.0.0.1:8000/, built again at each change
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs serve

acceptance: .venv/.ready  ## reconstruct real captures (MWDN_DATA or ../shared/data) into results/acceptance
	$(BIN)/python -m pytest -m acceptance -s

package: .venv/.ready  ## wheel and sdist in dist/; two builds of one commit are equal
	SOURCE_DATE_EPOCH=$$(git log -1 --format=%ct) $(BIN)/python -m hatchling build

benchmark: .venv/.ready  ## speed and memory against plain baselines in the same run
	$(BIN)/python benchmarks/admm.py
	$(BIN)/python benchmarks/memory.py
	$(BIN)/python benchmarks/train.py
	$(BIN)/python benchmarks/engine.py --memory

clean:
	rm -rf .venv results .pytest_cache .mypy_cache .ruff_cache
