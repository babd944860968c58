# Each target sets up its own environment: a fresh clone and Python 3.11 or later are enough.
PYTHON ?= python3
BIN := .venv/bin

.PHONY: demo test check docs acceptance package wheel-test lowest release benchmark clean

.venv/.ready: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	touch $@

demo: .venv/.ready  ## a synthetic camera, its captures, the untrained methods
	$(BIN)/mwdn demo

# Spinning threads slow down other processes on the same cores, so tests wait passively; a single process is faster without.
# Compiled modules are kept: the tests start Python a hundred times.
TESTS := OMP_WAIT_POLICY=passive OMP_NUM_THREADS=1 PYTHONDONTWRITEBYTECODE=

test: .venv/.ready  ## all tests except the slow ones on real captures
	$(TESTS) $(BIN)/python -m pytest -n auto --dist worksteal

check: .venv/.ready  ## lint, format, types, documentation
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

docs: .venv/.ready  ## the documentation site at http://127.0.0.1:8000/, built again at each change
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs serve

acceptance: .venv/.ready  ## reconstruct real captures (MWDN_DATA or ../shared/data) into results/acceptance
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[acceptance]'
	$(BIN)/python -m pytest -m acceptance -s

package: .venv/.ready  ## wheel and sdist in dist/; two builds of one commit are equal
	SOURCE_DATE_EPOCH=$$(git log -1 --format=%ct) $(BIN)/python -m hatchling build

# What a user has: the wheel in an environment of its own, and no folder `src` beside the tests.
wheel-test: package  ## the tests against the wheel
	rm -rf .wheel && mkdir .wheel && git ls-files | grep -v '^src/\|^recipes$$' | tar c -T - | tar x -C .wheel
	$(PYTHON) -m venv .wheel/.venv
	.wheel/.venv/bin/pip install --quiet --disable-pip-version-check -c constraints.txt \
		"$$(ls -t dist/*.whl | head -1)[test,docs]"
	cd .wheel && env -u PYTHONPATH $(TESTS) .venv/bin/python -m pytest -n auto --dist worksteal --ignore tests/test_architecture.py \
		--ignore tests/docs/test_assets.py \
		--deselect tests/docs/test_site.py::test_every_public_name_has_its_place_in_the_reference

lowest:  ## the tests with the lowest versions that pyproject.toml allows
	$(PYTHON) -m venv .venv-lowest
	.venv-lowest/bin/pip install --quiet --disable-pip-version-check -c constraints-lowest.txt -e \
		'.[parquet,fabrication,tensorboard,hub,scipy,export,raw,page]' \
		pytest pytest-xdist beartype scikit-image torchmetrics httpx2 hypothesis
	$(TESTS) .venv-lowest/bin/python -m pytest -n auto --dist worksteal

# Tools in environments of their own: cffconvert needs jsonschema 3, cyclonedx-bom needs a newer one.
release: package  ## what a release consists of: wheel, sdist, list of components (CycloneDX), checksums
	rm -rf .venv-release && for name in . cff sbom; do $(PYTHON) -m venv .venv-release/$$name; done
	.venv-release/cff/bin/pip install --quiet --disable-pip-version-check cffconvert==2.0.0
	.venv-release/cff/bin/cffconvert --validate
	.venv-release/sbom/bin/pip install --quiet --disable-pip-version-check cyclonedx-bom==7.5.0
	.venv-release/bin/pip install --quiet --disable-pip-version-check -c constraints.txt "$$(ls -t dist/*.whl | head -1)"
	.venv-release/sbom/bin/cyclonedx-py environment --output-reproducible --mc-type library --pyproject pyproject.toml \
		--output-file dist/mwdn.cdx.json .venv-release/bin/python
	cd dist && sha256sum mwdn-* mwdn.cdx.json > SHA256SUMS

benchmark: .venv/.ready  ## speed and memory against plain baselines in the same run
	$(BIN)/python benchmarks/admm.py
	$(BIN)/python benchmarks/memory.py
	$(BIN)/python benchmarks/train.py
	$(BIN)/python benchmarks/engine.py --memory

clean:
	rm -rf .venv .venv-lowest .venv-release .wheel results .pytest_cache .mypy_cache .ruff_cache
